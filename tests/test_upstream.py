"""TorchRL's methods that ours replace, since a copy does not follow when the original moves.

If this fails, TorchRL has changed one of them: compare the change with our method, take over what
it should have, and write the new fingerprint here.
"""

import hashlib
import inspect

import pytest
from torchrl.objectives import PPOLoss, SACLoss, TD3Loss

WRITTEN_ANEW = {
    # SACLagrangianLoss: both draw an action that the cost critics need too.
    (SACLoss, "actor_loss"): "465f9085e04d6b8e",
    (SACLoss, "_compute_target_v2"): "433c7bb137e06d52",
    # TD3LagrangianLoss: the same.
    (TD3Loss, "actor_loss"): "68017172cbb4eba5",
    (TD3Loss, "value_loss"): "dff535c81cdd36bf",
    # TrustRegionStep: the surrogate, of a distribution that is at hand.
    (PPOLoss, "forward"): "523b8909ec64c97f",
    (PPOLoss, "_log_weight"): "b1ec584703be67fb",
}


def fingerprint(method):
    """Of the code without comments, empty lines and indentation."""
    lines = (line.strip() for line in inspect.getsource(inspect.unwrap(method)).splitlines())
    code = "\n".join(line for line in lines if line and not line.startswith("#"))
    return hashlib.sha256(code.encode()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("owner", "name"), WRITTEN_ANEW, ids=lambda value: getattr(value, "__name__", value)
)
def test_what_is_written_anew_is_as_it_was(owner, name):
    assert fingerprint(getattr(owner, name)) == WRITTEN_ANEW[owner, name]
