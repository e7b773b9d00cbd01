"""Over guesses, horizons and prices of risk: what is tried, and which is best.

In:   a model, options, what is asked for.
Out:  outcomes and steered plans with their records.

:mod:`.attempt` is one guess by one method and what follows where it fails; :mod:`.starts` are
several guesses, :mod:`.warm_start` given ones, :mod:`.free_time` horizons (paper §5),
:mod:`.field` and :mod:`.steering` expected costs at prices of risk, :mod:`.price_search` the price
of a risk that is promised, :mod:`.replanning` a receding horizon, :mod:`.shot` shooting (§3.3).
"""
