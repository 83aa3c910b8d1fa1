"""The one error that means: what a person wrote is wrong."""


class InputError(ValueError):
    """Wrong input; ``str(error)`` is one line naming the place, the value, its unit and what would be right.

    A recipe prints that line and exits with code 2; everything else keeps its traceback.
    """
