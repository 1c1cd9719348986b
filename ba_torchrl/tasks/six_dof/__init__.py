"""The open-loop tasks in six degrees of freedom, one per file (appendix C)."""
