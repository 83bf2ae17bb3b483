"""Random faults in the shipped configurations: in their values, their keys, their text, and in overrides.

Each mutant is made from a seed of its own, so that one can be made again.
"""

import contextlib
import copy
import io
import math
import random
import shutil
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmsim.cli import main
from swarmsim.config.documents import dump_yaml, read_file
from swarmsim.config.errors import InputError
from swarmsim.config.files import packaged_dir
from swarmsim.config.scenario import load_scenario
from swarmsim.config.site_checks import check_site

KINDS = ("missions", "vehicles", "detectors", "sensors", "nuclides", "materials", "sites")
WEIGHTS = (10, 5, 3, 3, 1, 1, 2)
PATIENCE_S = 20.0  # a mutant that takes longer is stopped

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 65, 2001, 10**6, 2**31, 2**63, 10**17, 10**30, -(10**30), 0.0, -0.0, 5e-324, 1e-300, 1e-12, 1e-6,
    1e-3, 0.5, 1e3, 5e6, 1e12, 9e18, 1e38, 1e300, -1e300, math.nan, math.inf, -math.inf,
)  # fmt: skip
WORDS: tuple[Any, ...] = (
    None, True, False, "", " ", "all", "x", "name", "yes", "1e3", "20,5", "20 m", "0x1F", "..", "../..", "/dev/zero",
    "/etc/passwd", "~nobody/x.py:P", "a.py:", ":", "a:b:c", "os:abort", "json:dumps", "missing.py:Policy", "no/such:P",
    "\x00", "a\x00b.py:P", "\ud800", "\u202e", "\x1b[31m", "é" * 300, "x" * 5000, "[" * 100, "*", "&a", "!!int 3",
    "${jndi}", "{}", "%s%n", "recon", "tarot_t650", "orpheus", "Co-60", "concrete", "works_yard", "multirotor",
)  # fmt: skip
STRUCTURES: tuple[Callable[[], Any], ...] = (
    list,
    dict,
    lambda: [[]],
    lambda: [None] * 5,
    lambda: [0.0] * 3000,
    lambda: ["x"] * 3000,
    lambda: [{}] * 2500,
    lambda: {f"k{i}": i for i in range(3000)},
    lambda: {"name": "x"},
    lambda: _nested(20),
    lambda: _nested(200),
)


@dataclass(frozen=True)
class Mutant:
    """A fault: ``command`` is what the user does, with ``path`` written as ``content`` before."""

    seed: int
    what: str
    path: str
    content: bytes
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What came of a mutant: ``accepted``, ``refused``, or the last line of a traceback; ``time_s`` of processor."""

    mutant: Mutant
    result: str
    time_s: float
    message: str

    @property
    def told(self) -> bool:
        """Whether it was accepted, or refused with a sentence."""
        return self.result in ("accepted", "refused")


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def make_configs(folder: Path) -> None:
    """Fill ``folder/configs`` with all that is shipped."""
    ignore = shutil.ignore_patterns("*.py", "__pycache__")
    shutil.copytree(packaged_dir(), folder / "configs", ignore=ignore)


def make_mutant(seed: int) -> Mutant:
    """The mutant of a seed."""
    rng = random.Random(seed)
    kind = rng.choices(KINDS, WEIGHTS)[0]
    pattern = "*/site.yaml" if kind == "sites" else "*.yaml"
    file = rng.choice(sorted((packaged_dir() / kind).glob(pattern)))
    path = str(Path("configs") / file.relative_to(packaged_dir()))
    draw = rng.random()
    if kind == "missions" and draw < 0.4:
        overrides = tuple(_override(rng, read_file(file).data) for _ in range(rng.choice((1, 1, 1, 2, 3))))
        return Mutant(seed, f"--set {' --set '.join(overrides)}"[:300], path, file.read_bytes(), overrides)
    if draw < 0.6:
        content, what = _spoilt_text(rng, file.read_bytes())
        return Mutant(seed, what, path, content)
    data = read_file(file).data
    changes = [_change(rng, data) for _ in range(rng.choice((1, 1, 1, 2, 3, 5)))]
    return Mutant(seed, "; ".join(changes)[:300], path, dump_yaml(data).encode("utf-8", "surrogatepass"))


def _places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*place, key)
        yield from _places(inner, (*place, key))


def _holder(data: Any, place: tuple[Any, ...]) -> Any:
    for step in place[:-1]:
        data = data[step]
    return data


def _value(rng: random.Random, old: Any = None) -> Any:
    """A value in the stead of ``old``: near it, or of any type and size."""
    draw = rng.random()
    if isinstance(old, int | float) and not isinstance(old, bool) and draw < 0.5:
        return rng.choice((-old, old * 10.0 ** rng.randint(-30, 30), old * rng.uniform(0, 3), float(old), str(old)))
    if isinstance(old, str) and old and draw < 0.4:
        i = rng.randrange(len(old))
        return rng.choice((old[:i] + old[i + 1 :], old.upper(), old + "x", old * 50, [old], {old: old}))
    if isinstance(old, list) and draw < 0.5:
        return rng.choice(
            (old * 2, old * 500, old[:-1], old[::-1], [*old, None], [[x] for x in old], dict.fromkeys("ab", 1))
        )
    if draw < 0.75:
        return rng.choice(NUMBERS)
    return rng.choice(WORDS) if draw < 0.92 else rng.choice(STRUCTURES)()


def _change(rng: random.Random, data: Any) -> str:
    """Change ``data`` in place somewhere; what was done."""
    places = list(_places(data))
    if not places:
        return "nothing left to change"
    place = rng.choice(places)
    holder, key = _holder(data, place), place[-1]
    where = ".".join(map(str, place))
    draw = rng.random()
    if draw < 0.55:
        holder[key] = _value(rng, holder[key])
        return f"{where} = {str(holder[key])[:60]!r}"
    if draw < 0.7:
        del holder[key]
        return f"{where} removed"
    if draw < 0.8 and isinstance(holder, dict):
        holder[str(rng.choice((key + "x", key[:-1], key.upper(), "extends", "name", "", "a.b", "x" * 300)))] = (
            holder.pop(key)
        )
        return f"{where} renamed"
    other = rng.choice(places)
    holder[key] = copy.deepcopy(_holder(data, other)[other[-1]])
    return f"{where} = what stands at {'.'.join(map(str, other))}"


def _override(rng: random.Random, data: Any) -> str:
    place = [str(step) for step in rng.choice(list(_places(data)) or [("seed",)])]
    if rng.random() < 0.15:
        kind, names = rng.choice((("vehicles", ("tarot_t650", "orpheus")), ("detectors", ("nai_2x2",))))
        file = packaged_dir() / kind / f"{rng.choice(names)}.yaml"
        inner = rng.choice(list(_places(read_file(file).data)))
        place = ["definitions", kind, file.stem, *map(str, inner)]
    if rng.random() < 0.2:
        i = rng.randrange(len(place))
        place[i] = rng.choice(("", "x", "-1", "²", "9" * 5000, "99", place[i] + "x", "aerial", "time_step_s", "\x00"))
    value = _value(rng)
    text = rng.choice(
        ("", "[", "{a", "*a", "&a [*a]", "!!python/object:os.system x", "9" * 5000, "'", "a: b: c", "- - -")
    )
    text = text if rng.random() < 0.15 else dump_yaml(value).removesuffix("...\n").strip()
    return f"{'.'.join(place)}{rng.choice(('=', '=', '=', '=', '=', '', '=='))}{text}"


_INSERTED = (
    b"\x00", b"\xff\xfe", b"\xe9", b"\t", b"\r\n", b"---\n", b"...\n", b"&a [*a, *a]\n", b"*a",
    b"!!python/name:os.system ",
    b"<<: *a\n", b"? [a]\n: b\n", b"{", b"]", b"'", b'"\\ud800"', b": :", b"- ", b"#", b"%YAML 9.9\n", b"9" * 5000,
    b"0x" + b"f" * 5000, b".nan", b"1e999", b"x: [" + b"1," * 60_000 + b"]\n", b"x: " + b"[" * 3000, b"#" * 900_000,
    b"a: &a [x,x,x,x,x,x,x,x,x]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
    b"d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: &e [*d,*d,*d,*d,*d,*d,*d,*d,*d]\nf: [*e,*e,*e,*e,*e,*e,*e,*e,*e]\n",
)  # fmt: skip


def _spoilt_text(rng: random.Random, content: bytes) -> tuple[bytes, str]:
    """The bytes of a file spoilt, and what was done."""
    lines = content.splitlines(keepends=True)
    i = rng.randrange(len(lines))
    draw = rng.random()
    if draw < 0.1:
        return b"".join(lines[:i] + lines[i + 1 :]), f"line {i + 1} removed"
    if draw < 0.2:
        return b"".join([*lines[:i], lines[i] * rng.choice((2, 2000)), *lines[i + 1 :]]), f"line {i + 1} repeated"
    if draw < 0.3:
        return b"".join([*lines[:i], b" " * rng.randint(1, 5) + lines[i], *lines[i + 1 :]]), f"line {i + 1} indented"
    if draw < 0.35:
        return content[: rng.randrange(len(content))], "cut off"
    if draw < 0.4:
        encoding = rng.choice(("utf-16", "utf-32", "utf-7", "utf-8-sig", "cp037"))
        return content.decode("utf-8").encode(encoding, "replace"), f"in {encoding}"
    if draw < 0.45:
        return rng.randbytes(rng.choice((1, 100, 100_000))), "random bytes"
    if draw < 0.5:
        return content * rng.choice((2, 3000)), "repeated as a whole"
    inserted = rng.choice(_INSERTED)
    at = sum(map(len, lines[:i])) if rng.random() < 0.5 else rng.randrange(len(content))
    return content[:at] + inserted + content[at:], f"{inserted[:30]!r} inserted at byte {at}"


class _TooLong(BaseException):
    """The patience with a mutant is at its end."""


def _stop(*_: object) -> None:
    raise _TooLong


def judge(mutant: Mutant) -> Outcome:
    """Check the mutant as ``swarmsim check`` and ``swarmsim run`` do; the working folder is that of `make_configs`."""
    path = Path(mutant.path)
    original = path.read_bytes()
    path.write_bytes(mutant.content)
    said = io.StringIO()
    old = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    started = time.process_time()  # others may keep the machine busy
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            result = _told(mutant)
    except (Exception, _TooLong) as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        result = f"{type(error).__name__}: {error} at {frame.filename}:{frame.lineno}"[:400]
    finally:
        taken = time.process_time() - started
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, old)
        path.write_bytes(original)
    return Outcome(mutant, result, taken, said.getvalue())


def _told(mutant: Mutant) -> str:
    if mutant.overrides:
        try:
            problems = check_site(load_scenario(mutant.path, mutant.overrides))
        except InputError as error:
            str(error)
            return "refused"
        return "refused" if problems else "accepted"
    codes = [main(["check", mutant.path])]
    if "missions" not in mutant.path:  # a mission that takes it up
        codes.append(main(["check", "configs/missions/mixed.yaml"]))
    return "accepted" if not any(codes) else "refused"
