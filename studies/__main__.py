"""`python -m studies`: the studies there are, each with its question."""

from studies.frame import listing

if __name__ == "__main__":
    print(listing.show())
