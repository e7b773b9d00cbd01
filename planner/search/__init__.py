"""Over guesses, horizons and prices."""
