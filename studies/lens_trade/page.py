"""The page of the trade study."""


def write(run, tables):
    pass
