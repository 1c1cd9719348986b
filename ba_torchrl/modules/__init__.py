"""Networks and policies. They depend on image and action shapes, not on tasks."""
