"""An object whose unpickling is noticed."""

import os


class Planted:
    """Unpickling it creates a folder.

    Args:
        trace: path of the folder.
    """

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return os.mkdir, (str(self.trace),)
