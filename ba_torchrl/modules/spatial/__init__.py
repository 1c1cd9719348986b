"""Networks of open-loop tasks: a value per pixel, and per angle if the action has any."""
