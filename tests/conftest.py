"""Fixtures shared by the tests."""

import pytest


@pytest.fixture
def make_env():
    """Closes every environment that a test has made with it."""
    made = []

    def make(factory, *args, **kwargs):
        env = factory(*args, **kwargs)
        made.append(env)
        return env

    yield make
    for env in made:
        if not env.is_closed:
            env.close()
