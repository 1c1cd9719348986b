"""Controllers: close-loop motion, and open-loop pick and place."""
