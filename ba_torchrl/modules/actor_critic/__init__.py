"""Networks of close-loop tasks: policy, encoder and critics."""
