"""Records of what environments and training compute, to compare before and after a change."""
