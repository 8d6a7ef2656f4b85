"""Random numbers inside drjit kernels, without a state: hashes of a key per pixel and a counter, so that
chunks and threads change nothing."""

import math


def hashed(dr, bits):
    """32 well-mixed bits of 32 bits; one to one. Source: C. Wellons, "Prospecting for Hash Functions"
    (triple32, bias 0.02 of ideal)."""
    bits = (bits ^ (bits >> 17)) * 0xED5AD4BB
    bits = (bits ^ (bits >> 11)) * 0xAC4C1B51
    bits = (bits ^ (bits >> 15)) * 0x31848BAB
    return bits ^ (bits >> 14)


def uniform(arr, bits):
    """Number in (0, 1) of 32 bits, on a grid of 2^-23 (exact in single precision), never 0 or 1."""
    return (arr.Float(bits >> 9) + 0.5) * 2.0**-23


def exponential(dr, arr, bits):
    """Exponentially distributed number with mean 1, > 0."""
    return -dr.log(uniform(arr, bits))


def normal_pair(dr, arr, bits):
    """Two independent standard normal numbers of 32 bits (Box and Muller, 1958)."""
    radius = dr.sqrt(2 * exponential(dr, arr, hashed(dr, bits)))
    sine, cosine = dr.sincos((2 * math.pi) * uniform(arr, hashed(dr, bits + 0x9E3779B9)))
    return radius * cosine, radius * sine
