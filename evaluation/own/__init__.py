"""Controllers of one's own: functions, networks, models, objects, by name or as they are.

    from slipcar.evaluation.own import as_controller, load_controller, per_row

docs/controllers.md shows each kind in ten lines.
"""

from slipcar.evaluation.own.adapters import ActionFunction, StateFunction, per_row
from slipcar.evaluation.own.as_controller import as_controller
from slipcar.evaluation.own.load import load_controller, load_maker

__all__ = [
    "ActionFunction",
    "StateFunction",
    "as_controller",
    "load_controller",
    "load_maker",
    "per_row",
]
