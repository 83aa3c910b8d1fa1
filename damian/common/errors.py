"""The error raised for wrong input: a setting, a file or an argument."""


class InputError(ValueError):
    """Wrong input; ``str(error)`` is one line with the key or place, the value, its unit and the remedy.

    A recipe prints that line and exits with code 2; any other error keeps its traceback.
    """
