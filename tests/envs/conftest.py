from hypothesis import HealthCheck, settings

# Timings never decide a test: a loaded machine must not fail what a quiet one passes.
settings.register_profile(
    "untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("untimed")
