"""Where the packages go; all else is in pyproject.toml. A wheel carries scenes and studies inside
codesign (codesign.shipped), where they shadow nobody's own."""

import sys

from setuptools import find_packages, setup

SHIPPED = ("scenes", "studies")
# an editable install leaves them at the top of the checkout, as the tests import them
INSIDE = "" if "editable_wheel" in sys.argv else "codesign._shipped."

setup(
    packages=find_packages(include=["codesign*"])
    + [INSIDE + name for name in find_packages(include=[f"{top}*" for top in SHIPPED])],
    package_dir={INSIDE + top: top for top in SHIPPED},
)
