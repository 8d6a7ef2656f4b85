"""`python -m studies`: the studies there are, each with its question."""

from codesign.interrupt import written_out
from studies.frame import listing

if __name__ == "__main__":
    with written_out():
        print(listing.show())
