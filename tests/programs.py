"""Programs in processes of their own, without the seconds that each import of TorchRL takes.

They are forked from a server that has imported PyTorch and TorchRL, and nothing of ours.
"""

import multiprocessing
import os
import runpy
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

PRELOADED = ["torch", "torchrl.collectors", "torchrl.envs", "torchrl.modules", "torchrl.objectives"]


@dataclass(frozen=True)
class Done:
    """What is left of a program that has ended."""

    returncode: int | None
    stdout: str
    stderr: str


def run_program(path, *arguments, folder=None, strict=None, timeout=240):
    """Runs a program as ``python path arguments`` does.

    Args:
        path: of the program.
        arguments: of the command line.
        folder: where it runs; here by default.
        strict: a kind of warning that is an error in the program.
        timeout: seconds after which it is killed and ``returncode`` is not 0.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    with tempfile.TemporaryDirectory() as outputs:
        process = context.Process(
            target=_run, args=(str(path), [*map(str, arguments)], folder, strict, outputs)
        )
        process.start()
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
        texts = [Path(outputs, name).read_text(encoding="utf-8") for name in ("stdout", "stderr")]
    return Done(process.exitcode, *texts)


def run_code(code, *arguments, **settings):
    """Runs a program as ``python -c code`` does."""
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary, "program.py")
        path.write_text(code, encoding="utf-8")
        return run_program(path, *arguments, **settings)


def _run(path, arguments, folder, strict, outputs):
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(outputs, name), os.O_CREAT | os.O_WRONLY), number)
    if folder is not None:
        os.chdir(folder)
    if strict is not None:
        warnings.simplefilter("error", strict)
    sys.argv = [path, *arguments]
    sys.path[0] = str(Path(path).parent)
    runpy.run_path(path, run_name="__main__")
