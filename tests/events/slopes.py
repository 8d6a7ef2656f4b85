"""How alike derivatives and differences are."""


def cosine_and_scale(found, truth):
    """Of two vectors: whether one points where the other does, and how long it is beside it."""
    return float(found @ truth / (found.norm() * truth.norm())), float(
        found @ truth / (truth @ truth)
    )
