"""What is solved: a user's object, checked, with derivatives (paper §2, §5).

In:   any object that satisfies :class:`.protocol.Problem`.
Out:  a `Model`: its numbers as arrays, its functions, their derivatives (given, traced, or by
      differences); what is known along a trajectory (:mod:`.linearization`).

:mod:`.numbers` and :mod:`.answers` look at what the problem names and answers, :mod:`.checks` at
what the method assumes of it: drift affine in the control, σ of certain states (paper §6.1).
"""
