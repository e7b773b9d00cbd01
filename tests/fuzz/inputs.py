"""The names that the repr of an input uses."""

import numpy as np
from numpy import array, float32, inf, nan

from .damage import Damage
from .problems import Kind, Recipe
from .worlds import World

__all__ = ["Damage", "Kind", "Recipe", "World", "array", "float32", "inf", "nan", "np"]
