import pytest
from small_losses import make

from redig.objectives import DIPOLoss, QWeightedLoss

LOSSES = {
    "dipo": (DIPOLoss, {}),
    "qvpo": (QWeightedLoss, {"num_candidates": 3}),
    "dpmd": (QWeightedLoss, {"num_candidates": 3, "weighting": "exponential"}),
}


@pytest.fixture(params=LOSSES)
def build(request):
    """Make one of the losses with ``make``, or another function that takes its class and options."""
    cls, options = LOSSES[request.param]
    return lambda make=make, **more: make(cls, **{**options, **more})
