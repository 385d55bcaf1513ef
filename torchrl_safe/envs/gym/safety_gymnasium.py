"""Names of Safety-Gymnasium's environments, and which library makes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec

import gymnasium

_MODULE = "safety_gymnasium"


def find_maker(env_name: str) -> tuple[Callable[..., gymnasium.Env], str]:
    """Returns the function that makes an environment, and the name by which it knows it.

    Safety-Gymnasium registers all its environments with Gymnasium, but those that return six
    values from ``step`` fail in the wrappers that Gymnasium puts around them; its own ``make`` has
    wrappers for them. The name says what to import, so that it is known in every process.
    """
    _, _, name = env_name.rpartition(":")
    if not name.startswith("Safety") or find_spec(_MODULE) is None:
        return gymnasium.make, env_name
    import safety_gymnasium
    from safety_gymnasium.utils.registration import safe_registry

    if name in safe_registry:
        return safety_gymnasium.make, name
    return gymnasium.make, f"{_MODULE}:{name}" if name in gymnasium.registry else env_name


def vector_env(
    factories: Sequence[Callable[[], gymnasium.Env]], *, asynchronous: bool
) -> gymnasium.vector.VectorEnv:
    """Several environments whose ``step`` returns six values."""
    from safety_gymnasium.vector import SafetyAsyncVectorEnv, SafetySyncVectorEnv

    return (SafetyAsyncVectorEnv if asynchronous else SafetySyncVectorEnv)(factories)
