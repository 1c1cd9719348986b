"""Networks and policies: they know shapes, not tasks."""
