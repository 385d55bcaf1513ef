"""Checkpoints: what is kept, and what a torn, foreign, hostile or unwritable file does."""

import json
import pickle
import resource
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointError

from torchrl_safe.checkpoint import RunCheckpoints, refuse_other_settings


@pytest.fixture
def net():
    return torch.nn.Linear(3, 2)


@pytest.fixture
def run(tmp_path, net):
    return RunCheckpoints(tmp_path / "checkpoints", {"net": net}, settings={"arms": ("a", "b")})


def save(run, net, step, **kwargs):
    with torch.no_grad():
        net.weight.fill_(step)
    return run.save(step, **kwargs)


def weight_after_load(run, net):
    with torch.no_grad():
        net.weight.fill_(-1)
    run.load()
    return net.weight.unique().tolist()


def test_the_last_two_and_the_best_are_kept(run, net):
    scores = {1: 1.0, 2: 5.0, 3: None, 4: float("nan"), 5: 2.0, 6: None}
    paths = {step: save(run, net, step, score=score) for step, score in scores.items()}
    assert sorted(run.folder.iterdir()) == [paths[2], paths[5], paths[6]]
    assert run.best() == paths[2]
    assert run.load() == 6
    assert net.weight.unique().tolist() == [6]
    Checkpoint(net=net).load(run.best())
    assert net.weight.unique().tolist() == [2]


def test_a_score_of_zero_is_a_score(run, net):
    best = save(run, net, 1, score=0.0)
    for step in (2, 3, 4):
        save(run, net, step, score=-1.0)
    assert run.best() == best


def test_as_many_are_kept_as_asked_for(tmp_path, net):
    run = RunCheckpoints(tmp_path, {"net": net}, keep_last=3)
    paths = [save(run, net, step) for step in range(5)]
    assert sorted(tmp_path.iterdir()) == paths[2:]


def test_without_checkpoints_nothing_is_loaded(run, net):
    before = net.weight.clone()
    assert run.load() is None
    assert torch.equal(before, net.weight)
    assert run.best() is None
    save(run, net, 1)
    notes = run.folder / "notes.txt"
    notes.touch()
    run.clear()
    assert run.load() is None
    assert list(run.folder.iterdir()) == [notes], "only checkpoints are removed"


def test_tensors_can_be_put_elsewhere(run, net):
    save(run, net, 3)
    assert run.load(map_location="cpu") == 3
    assert net.weight.unique().tolist() == [3]
    # It reaches torch.load: nothing can be copied from the meta device.
    with pytest.raises(CheckpointError, match="meta"):
        run.load(map_location="meta")


def test_a_folder_that_cannot_be_made(tmp_path, net):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(OSError, match=r"file.checkpoints"):
        RunCheckpoints(file / "checkpoints", {"net": net}).save(1)


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def empty(path):
    path.write_bytes(b"")


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    position = content.index(torch.full((6,), 2.0).numpy().tobytes())
    content[position + 3] ^= 1
    path.write_bytes(content)


def without_a_part(path):
    Checkpoint(format="archive", other=torch.nn.Linear(3, 2)).save(path)


def of_another_network(path):
    path.unlink()
    net = torch.nn.Linear(4, 2)
    RunCheckpoints(path.parent, {"net": net}, settings={"arms": ["a", "b"]}).save(2)


def of_another_run(path):
    path.unlink()
    RunCheckpoints(path.parent, {"net": torch.nn.Linear(3, 2)}, settings={"arms": ["c"]}).save(2)


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (cut, "Path does not contain|Invalid checkpoint|not a"),
        (empty, "Path does not contain|Invalid checkpoint|not a"),
        (flip_a_bit, "Bad CRC-32"),
        (without_a_part, r"settings"),
        (of_another_network, "size mismatch for weight"),
        (of_another_run, r"arms was \['c'\] and is now \['a', 'b'\]"),
    ],
)
def test_what_cannot_be_used_is_named_and_the_one_before_is_used(run, net, harm, reason):
    first, second = (save(run, net, step) for step in (1, 2))
    harm(second)
    with pytest.warns(UserWarning, match=f"(?s){second}.*({reason})"):
        assert weight_after_load(run, net) == [1]
    # The run goes on, and writes in its place.
    save(run, net, 2)
    assert weight_after_load(run, net) == [2]
    for path in (first, second):
        cut(path)
    with pytest.raises(CheckpointError, match=f"(?s)can be used.*{second}.*{first}"):
        run.load()


def test_wherever_a_bit_flips_the_one_before_is_used(run, net):
    """In the archive's own headers too, where readers fail in many ways."""
    save(run, net, 1)
    second = save(run, net, 2)
    whole = second.read_bytes()
    places = [*range(0, 120, 7), *range(len(whole) - 330, len(whole), 11)]
    used = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for place in places:
            torn = bytearray(whole)
            torn[place] ^= 4
            second.write_bytes(torn)
            (weight,) = weight_after_load(run, net)
            used.add(weight)
    # Some bits of a header do not matter. Then the second checkpoint is read, whole.
    assert used <= {1, 2}
    assert 1 in used


class Exploit:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("kind", ["pickle", "tensordict"])
def test_loading_runs_no_foreign_code(run, net, tmp_path, kind):
    path, proof = save(run, net, 1), tmp_path / "executed"
    parts = tmp_path / "parts"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(parts)
        manifest = json.loads(archive.read("manifest.json"))
    component = parts / manifest["components"]["net"]["path"]
    (component / "state.pt").unlink()
    if kind == "pickle":
        (component / "state.pt").write_bytes(pickle.dumps(Exploit(proof)))
    else:
        TensorDict(a=NonTensorData(Exploit(proof))).memmap(component / "state")
        (component / "state.json").write_text('{"kind": "dict", "items": []}')
    proof.unlink(missing_ok=True)
    files = [p.relative_to(component).as_posix() for p in component.rglob("*") if p.is_file()]
    manifest["components"]["net"]["files"] = files
    (parts / "manifest.json").write_text(json.dumps(manifest))
    with zipfile.ZipFile(path, "w") as archive:
        for file in parts.rglob("*"):
            archive.write(file, file.relative_to(parts))
    with pytest.raises(CheckpointError, match=r"not what this class writes|[Ww]eights.only|pickle"):
        run.load()
    assert not proof.exists()


def test_a_full_disk_leaves_the_one_before(run, net):
    """The system itself refuses to write: files of this process cannot grow any more."""
    first = save(run, net, 1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="could not be written") as failure:
            save(run, net, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "checkpoint-000000000002.torchrl could not be written (" in str(failure.value)
    assert "bytes are free there)" in str(failure.value)
    assert f"newest before it is {first}." in str(failure.value)
    assert list(run.folder.iterdir()) == [first]
    assert weight_after_load(run, net) == [1]


def test_a_name_that_is_no_file_is_refused_at_once(tmp_path, net):
    with pytest.raises(ValueError, match="path separators"):
        RunCheckpoints(tmp_path, {"a/b": net})


def test_an_error_of_a_component_is_its_own(run, net):
    """Not one of the disk."""

    class Closed(torch.nn.Module):
        def state_dict(self):
            raise RuntimeError("This arm is closed.")

    save(run, net, 1)
    other = RunCheckpoints(run.folder, {"net": net, "arm": Closed()}, settings=run.settings)
    with pytest.raises(RuntimeError, match=r"^This arm is closed\.$"):
        other.save(2)
    assert run.load() == 1


def test_what_could_not_be_loaded_is_not_saved(run, net):
    """Its place in the state is named: load takes no classes of others."""
    optimizer = torch.optim.SGD(net.parameters(), lr=0.1)
    other = RunCheckpoints(run.folder, {"optimizer": optimizer})
    other.save(1)
    optimizer.param_groups[0]["lr"] = np.linspace(0.1, 0, 2)[1]
    where = r"components\['optimizer'\]\.state_dict\(\)\['param_groups'\]\[0\]\['lr'\]"
    with pytest.raises(TypeError, match=rf"{where} must be .* of <class 'numpy.float64'>"):
        other.save(2)
    assert other.load() == 1


def test_a_name_that_could_not_be_loaded_is_not_saved(run, net):
    class Counts(torch.nn.Module):
        def state_dict(self):
            return {"seen": {np.int64(3): 1}}

    other = RunCheckpoints(run.folder, {"counts": Counts()})
    where = r"a key of components\['counts'\]\.state_dict\(\)\['seen'\]"
    with pytest.raises(TypeError, match=rf"{where} must be .* of <class 'numpy.int64'>"):
        other.save(1)


def test_what_a_killed_process_left_is_cleared_away(run, net):
    save(run, net, 1)
    left = run.folder / ".unfinished" / "checkpoint-000000000002.torchrl"
    left.parent.mkdir()
    left.write_bytes(b"half")
    assert run.load() == 1
    save(run, net, 2)
    assert not left.parent.exists()
    left.parent.mkdir()
    left.write_bytes(b"half")
    run.clear()
    assert not list(run.folder.iterdir())


def test_a_run_saves_neither_before_nor_over_what_another_has_saved(run, net):
    """The rotation keeps the highest steps: it would remove the new file at once.

    A run may save its own last step again.
    """
    save(run, net, 90)
    other = RunCheckpoints(run.folder, {"net": net}, settings={"arms": ("c",)})
    for step in (10, 90):
        with pytest.raises(
            ValueError, match=rf"step must be more .* got {step}, .*-000000000090.torchrl"
        ):
            other.save(step)
    assert run.load() == 90
    save(run, net, 90)
    other.clear()
    assert other.save(10).exists()
    assert other.load() == 10


def test_a_run_may_save_its_own_last_step_again(run, net):
    """As one that is resumed at its end does."""
    save(run, net, 1)
    save(run, net, 1)
    resumed = RunCheckpoints(run.folder, {"net": net}, settings=run.settings)
    assert resumed.load() == 1
    save(resumed, net, 1)
    assert len(list(run.folder.iterdir())) == 1


def test_what_was_skipped_is_removed_by_the_next_save(run, net):
    save(run, net, 5)
    save(run, net, 9).write_bytes(b"torn")
    with pytest.warns(UserWarning, match="Going on from"):
        assert run.load() == 5
    saved = save(run, net, 7)
    assert [path.name[-10:] for path in sorted(run.folder.iterdir())] == [
        "05.torchrl",
        "07.torchrl",
    ]
    assert run.load() == 7
    assert saved.exists()


@pytest.mark.parametrize("step", [-1, 1.5, True, 10**12])
def test_steps_are_whole_numbers(run, step):
    with pytest.raises(ValueError, match="step must be a whole number of at least 0, got"):
        run.save(step)


@pytest.mark.parametrize("score", ["5", True, [1.0]])
def test_scores_are_numbers(run, score):
    with pytest.raises(ValueError, match="score must be a number, got"):
        run.save(1, score=score)


def test_components_have_names(tmp_path, net):
    with pytest.raises(TypeError, match=r"components must be an instance of Mapping, got \["):
        RunCheckpoints(tmp_path, [net])


@pytest.mark.parametrize(
    ("components", "error", "message"),
    [
        ({}, ValueError, "components must have at least one object, got none"),
        ({"epoch": 3}, TypeError, r"components\['epoch'\] must be .* no load_state_dict"),
        ({"net": torch.nn.Linear}, TypeError, r"components\['net'\] must be .* a class"),
    ],
    ids=["none", "number", "class"],
)
def test_components_have_a_state(tmp_path, components, error, message):
    with pytest.raises(error, match=message):
        RunCheckpoints(tmp_path, components)


def test_a_component_that_was_saved_must_be_loaded(tmp_path, net):
    RunCheckpoints(tmp_path, {"net": net, "updater": net}).save(1)
    with pytest.raises(CheckpointError, match=r"components must have \['updater'\] too, which it"):
        RunCheckpoints(tmp_path, {"net": net}).load()


def test_settings_that_are_nan_are_the_same(tmp_path, net):
    settings = {"lr": float("nan"), "inner": {"rate": float("nan")}}
    RunCheckpoints(tmp_path, {"net": net}, settings=settings).save(1)
    assert RunCheckpoints(tmp_path, {"net": net}, settings=settings).load() == 1


def test_settings_that_differ_are_named():
    same = {"lr": 0.1, "seed": 0, "old": 1}
    refuse_other_settings(same, dict(same))
    with pytest.raises(ValueError, match=r"costs was {'a': 1, 'b': 2} and is now {'b': 2, 'a': 1}"):
        refuse_other_settings({"costs": {"a": 1, "b": 2}}, {"costs": {"b": 2, "a": 1}})
    with pytest.raises(ValueError, match=r"lr was 0.1 and is now 0.2, new was None and is now 3, "):
        refuse_other_settings(same, {"lr": 0.2, "seed": 0, "new": 3})


def test_settings_must_be_json(tmp_path, net):
    with pytest.raises(TypeError, match="not JSON serializable"):
        RunCheckpoints(tmp_path, {"net": net}, settings={"path": tmp_path})
