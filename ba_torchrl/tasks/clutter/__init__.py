"""Parts of the tasks that grasp objects from a heap in a tray."""
