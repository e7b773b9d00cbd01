import os
import sys

from hypothesis import HealthCheck, settings

# Timings never decide a test: a loaded machine must not fail what a quiet one passes. In CI the
# examples are the same every time, so that a change is not turned away for what it did not touch;
# elsewhere they differ from run to run, and find more.
settings.register_profile(
    "untimed",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    print_blob=True,
    derandomize=os.environ.get("CI", "").lower() in {"1", "true"},
)
settings.load_profile("untimed")

# Some tests edit a module that they wrote within the same second, to as many characters: Python
# takes the bytecode of the last one for it, where there is any.
sys.dont_write_bytecode = True
