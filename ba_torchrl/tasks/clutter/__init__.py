"""What the tasks share that grasp objects from a heap in a tray."""
