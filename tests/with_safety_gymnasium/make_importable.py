"""Makes the installed Safety-Gymnasium 1.0.0 importable on Python 3.11.

There ``dataclasses`` refuses arrays as defaults of fields. The defaults become factories.
"""

import re
from importlib.util import find_spec
from pathlib import Path

ARRAY_DEFAULT = re.compile(r"^(    \w+: np\.(?:nd)?array) = ((?:COLOR|GROUP)\[.*\])$", re.MULTILINE)


def main() -> None:
    spec = find_spec("safety_gymnasium")
    assert spec is not None
    assert spec.origin is not None
    for source in Path(spec.origin).parent.rglob("*.py"):
        before = source.read_text(encoding="utf-8")
        after = ARRAY_DEFAULT.sub(r"\1 = field(default_factory=lambda: \2)", before)
        if after != before:
            importing = "from dataclasses import dataclass\n"
            after = after.replace(importing, "from dataclasses import dataclass, field\n")
            source.write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()
