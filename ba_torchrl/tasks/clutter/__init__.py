"""Tasks that take objects out of a heap in a tray."""
