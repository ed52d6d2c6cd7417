"""The one kind of error that a user is meant to read."""


class UserError(Exception):
    """Something that the user can mend: the message names the file and the remedy in one line.

    The command line prints the message alone, without a traceback, and exits with status 1.
    Anything else that is raised is a defect of ours and keeps its traceback.
    """
