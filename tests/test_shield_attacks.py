"""Attacks on the shield: nothing that is tried makes the arm touch."""

import json

import attack
import pytest
from worlds import ENGINES, Places, each_arm

from torchrl_safe.envs import PANDA, UR5, Cylinder, InFront, Shield


@pytest.mark.parametrize("kind", attack.ATTACKS)
@pytest.mark.parametrize("action", attack.ACTIONS)
def test_no_attack_makes_it_touch_what_stands(make_env, engine, action, kind):
    env = make_env(
        attack.make, PANDA, attack.ACTIONS[action], InFront(), ENGINES[engine], 8, seed=1
    )
    tally = attack.play(env, attack.ATTACKS[kind], 25)
    assert tally.steps == 200
    assert tally.touches == tally.table == 0


def test_what_the_next_step_needs_is_looked_at(make_env):
    """A stretched arm along the table, joints at full speed against each other: it sank to it."""
    env = make_env(
        attack.make, UR5, attack.ACTIONS["cartesian"], InFront(), ENGINES["mujoco"], 32, seed=119
    )
    tally = attack.play(env, attack.corners, 20, seed=19)
    assert tally.touches == tally.table == 0, str(tally)


def test_attacks_go_on_where_they_were_stopped(tmp_path, monkeypatch, capsys):
    out, played = tmp_path / "attack.json", []
    play = attack.play
    monkeypatch.setattr(attack, "play", lambda *a: played.append(a[1].__name__) or play(*a))
    options = ["--steps", "24", "--envs", "2", "--arms", "Panda", "--layouts", "in-front"]
    monkeypatch.setattr("sys.argv", ["attack.py", *options, "--out", str(out)])
    attack.main()
    assert played == [*attack.ATTACKS] * 2
    text = capsys.readouterr().out
    assert "all: 24 steps" in text
    kept = json.loads(out.read_text())
    kept.pop(next(iter(kept)))
    out.write_text(json.dumps(kept))
    attack.main()
    assert played[6:] == ["random"]
    assert capsys.readouterr().out == text


def test_the_attacks_would_touch_it_else(make_env):
    """Without the shield's rows: margins and rates that allow everything."""
    lax = Shield(margin=0.0, table=0.0, rate=1e6, acceleration=1e6)
    settings = {"shield": lax, "seed": 1}
    action, physics = attack.ACTIONS["cartesian"], ENGINES["mujoco"]
    env = make_env(attack.make, PANDA, action, InFront(), physics, 8, **settings)
    assert attack.play(env, attack.greedy, 25).touches > 0


@pytest.mark.slow
@each_arm
@pytest.mark.parametrize("layout", attack.FIXED)
@pytest.mark.parametrize("action", attack.ACTIONS)
def test_no_long_attack_makes_any_arm_touch_what_stands(make_env, engine, arm, action, layout):
    physics = ENGINES[engine]
    for kind in attack.ATTACKS:
        env = make_env(
            attack.make, arm, attack.ACTIONS[action], attack.FIXED[layout], physics, 16, seed=2
        )
        tally = attack.play(env, attack.ATTACKS[kind], 100)
        assert tally.touches == tally.table == 0, f"{kind}: {tally}"


@pytest.mark.slow
@pytest.mark.parametrize("layout", attack.MOVING)
@pytest.mark.parametrize("action", attack.ACTIONS)
def test_the_arm_never_moves_into_what_moves(make_env, engine, action, layout):
    """A person may move into it, and press it onto the table."""
    for kind in attack.ATTACKS:
        env = make_env(
            attack.make,
            PANDA,
            attack.ACTIONS[action],
            attack.MOVING[layout],
            ENGINES[engine],
            16,
            seed=3,
        )
        tally = attack.play(env, attack.ATTACKS[kind], 100)
        assert tally.own == 0, f"{kind}: {tally}"


@pytest.mark.slow
@pytest.mark.parametrize("action", attack.ACTIONS)
def test_no_sequence_that_is_searched_for_touches(make_env, action):
    """By the cross-entropy method, with all episodes alike."""
    layout = Places(Cylinder(), at=[(0.5, 0.05, 0.1)])
    physics = ENGINES["mujoco"]
    env = make_env(attack.make, PANDA, attack.ACTIONS[action], layout, physics, 32)
    tally = attack.evolve(env, generations=20, length=20)
    assert tally.touches == tally.table == 0, str(tally)
    assert tally.nearest < 0.05
