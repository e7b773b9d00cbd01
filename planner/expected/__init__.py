"""Plans by their expected cost: noise, feedback and the risk of collision counted (SPEC §4).

* `stakes`: what is charged;
* `losses`: what a constraint costs when the state is Gaussian;
* `belief`: covariance, gains and adjoint weights along an iterate;
* `loop`: the iteration; `compiled`, its arrays, `run`: the same in machine code.
"""
