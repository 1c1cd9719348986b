"""Records of the results of environments and training, for comparison before and after a change."""
