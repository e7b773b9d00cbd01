"""Mean and spread: covariance, gains, what noise and rows cost, Monte Carlo (paper §6.2).

In:   matrices A, B, σ, σ′ along a trajectory; what is at stake.
Out:  Σ, gains K, the weights P of noise, losses of rows with their derivatives, rates on paths.

:mod:`.propagation` has the equations of one node, for numbers and for expressions;
:mod:`.covariance` and :mod:`.gains` run them along a trajectory of numbers, the kernels of Newton's
method on expressions. :mod:`.losses` says what a row costs, certain or Gaussian.
"""
