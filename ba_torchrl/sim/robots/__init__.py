"""Robot arms; each file registers its own."""
