"""What the experts of several tasks share: grasps, clearances, commands and motions."""
