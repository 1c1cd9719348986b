"""The open-loop tasks (appendix A.1)."""
