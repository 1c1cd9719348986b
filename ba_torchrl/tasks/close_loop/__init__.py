"""The close-loop tasks (appendix A.2)."""
