"""Reading TOML: mistakes are refused with file, line and remedy; everything else is read as written."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, Source, describe, frozen_array, limits_of, quantity, read_toml
from firmware_py.description.toml_text import to_toml


@dataclass(frozen=True, kw_only=True, eq=False)
class Fin:
    angle: float = quantity(unit="rad", low=-1.0, high=1.0, help="deflection")
    span_m: np.ndarray = quantity([1, 2], unit="m", low=0.0, high=9.0, shape=(2,), help="root and tip")

    def __post_init__(self) -> None:
        if self.angle == 0.5:
            raise DescriptionError("angle must not be one half", "angle")


@dataclass(frozen=True, kw_only=True, eq=False)
class Boat:
    name: str = quantity(help="its name")
    length_m: float = quantity(unit="m", low=0.1, high=100.0, help="over all")
    crew: int = quantity(1, low=0, high=12, help="people")
    sails: bool = quantity(True, help="whether it has any")
    rig: str = quantity("sloop", choices=("sloop", "ketch"), help="kind")
    inertia: np.ndarray = quantity([[1, 0], [0, 1]], low=-5, high=5, shape=(2, 2), help="matrix")
    depths: np.ndarray = quantity([], unit="m", low=0, high=50, shape=(-1,), help="any number of them")
    keel: Fin = quantity(Fin(angle=0.0), help="below")
    fin: tuple[Fin, ...] = quantity((), help="the others")
    flags: tuple[str, ...] = quantity((), choices=("red", "green"), help="shown")
    mate: str | None = quantity(None, help="may be absent")
    heel: float = quantity(0.0, help="any number")

    def __post_init__(self) -> None:
        if self.mate == self.name:
            raise DescriptionError("mate must not be the captain", "mate")


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    text: str = quantity('a "quoted" \\ word')
    size_m: float = quantity(0.1, unit="m")
    count: int = quantity(3)
    on: bool = quantity(True)
    matrix: np.ndarray = quantity([[1.5, -2], [0, 1e-9]], shape=(2, 2))
    keel: Fin = quantity(Fin(angle=0.25))


GOOD = """\
# a comment
name = "Ann"
length_m = 7.5

[keel]
angle = 0.1

[[fin]]
angle = 0.2

[[fin]]
angle = -0.3
span_m = [0.5, 0.25]
"""


def load(folder: Path, text: str) -> Boat:
    path = folder / "boat.toml"
    path.write_text(text)
    table, source = read_toml(path)
    boat: Boat = build(Boat, table, source)
    return boat


def refusal(folder: Path, text: str) -> str:
    """The error message without the folder; checks that it is one line."""
    with pytest.raises(DescriptionError) as caught:
        load(folder, text)
    words = str(caught.value)
    assert "\n" not in words
    return words.replace(f"{folder}/", "")


def test_what_is_written_comes_through_and_the_rest_is_default(tmp_path: Path) -> None:
    boat = load(tmp_path, GOOD)
    assert (boat.name, boat.length_m) == ("Ann", 7.5)
    assert (boat.crew, boat.sails, boat.rig, boat.mate) == (1, True, "sloop", None)
    assert [fin.angle for fin in boat.fin] == [0.2, -0.3]
    np.testing.assert_array_equal(boat.fin[1].span_m, [0.5, 0.25])
    np.testing.assert_array_equal(boat.inertia, np.eye(2))
    assert boat.depths.shape == (0,)


NAME = 'name = "Ann"\n'
TOP = NAME + "length_m = 7.5\n"
KNOWN = "crew, depths, fin, flags, heel, inertia, keel, length_m, mate, name, rig, sails"

WRONG = {
    "unknown key": (TOP + "colour = 3\n", f"3: colour: unknown key; permitted here: {KNOWN}"),
    "unknown table": (TOP + "[engine]\nhp = 3\n", "3: engine: unknown key; permitted here: crew"),
    "unknown key in a table": (
        TOP + "[keel]\nangle = 0.1\nchord = 2\n",
        "5: keel.chord: unknown key; permitted here: angle, span_m",
    ),
    "unknown key in a row": (
        TOP + "[[fin]]\nangle = 0.1\n\n[[fin]]\nangle = 0.1\nchord = 2\n",
        "8: fin[1].chord: unknown key; permitted here: angle, span_m",
    ),
    "unknown key in capitals": (TOP + "CREW = 3\n", f"3: CREW: unknown key; did you mean crew? permitted here: {KNOWN}"),
    "unknown key like another": (TOP + "craw = 3\n", f"3: craw: unknown key; did you mean crew? permitted here: {KNOWN}"),
    "unknown word like another": (TOP + 'rig = "slop"\n', "3: rig: 'slop' is unknown; did you mean sloop? permitted: one of sloop, ketch"),
    "unit left out": (
        TOP + "[keel]\nangle = 0.1\nspan = 2\n",
        "5: keel.span: unknown key; did you mean span_m? permitted here: angle, span_m",
    ),
    "truth for a whole number": (TOP + "crew = true\n", "3: crew: true is not a whole number"),
    "tables for a table": (TOP + "[[keel]]\nangle = 0.1\n", "3: keel: must be a table, [keel], and one alone"),
    "missing text": ("length_m = 7.5\n", "1: name: missing key; it needs text"),
    "missing": (NAME, "1: length_m: missing key; it needs 0.1 to 100 m"),
    "missing in a table": (
        TOP + "crew = 2\n[keel]\nspan_m = [1, 2]\n",
        "4: keel.angle: missing key; it needs -1 to 1 rad",
    ),
    "missing in a row": (
        TOP + "[[fin]]\nangle = 0\n[[fin]]\nspan_m = [1, 2]\n",
        "5: fin[1].angle: missing key; it needs -1 to 1 rad",
    ),
    "duplicate key": (TOP + 'name = "Bea"\n', "3: not valid TOML"),
    "duplicate table": (TOP + "[keel]\nangle = 0\n[keel]\nangle = 1\n", "5: not valid TOML"),
    "no TOML": (TOP + "crew = = 3\n", "3: not valid TOML"),
    "too large": (NAME + "length_m = 100.1\n", "2: length_m: 100.1 is out of range; permitted: 0.1 to 100 m"),
    "too small": (NAME + "\nlength_m = -1\n", "3: length_m: -1 is out of range; permitted: 0.1 to 100 m"),
    "NaN": (NAME + "length_m = nan\n", "2: length_m: nan is out of range; permitted: 0.1 to 100 m"),
    "infinite": (NAME + "length_m = inf\n", "2: length_m: inf is out of range; permitted: 0.1 to 100 m"),
    "text for a number": (NAME + 'length_m = "7"\n', "2: length_m: '7' is not a number; permitted: 0.1 to 100 m"),
    "truth for a number": (NAME + "length_m = true\n", "2: length_m: true is not a number; permitted: 0.1 to 100 m"),
    "number for truth": (TOP + "sails = 1\n", "3: sails: 1 is not true or false"),
    "number for text": ("name = 3\nlength_m = 7.5\n", "1: name: 3 is not text"),
    "fraction for a whole number": (TOP + "crew = 1.5\n", "3: crew: 1.5 is not a whole number"),
    "date for a number": (TOP + "crew = 2020-01-01\n", "3: crew: 2020-01-01 is not a whole number"),
    "unknown word": (TOP + 'rig = "junk"\n', "3: rig: 'junk' is unknown; permitted: one of sloop, ketch"),
    "unknown word in a list": (
        TOP + 'flags = ["red", "blue"]\n',
        "3: flags[1]: 'blue' is unknown; permitted: one of red, green",
    ),
    "word for a list": (TOP + 'flags = "red"\n', "3: flags: must be a list"),
    "number for a table": (TOP + "keel = 3\n", "3: keel: must be a table, [keel], and one alone"),
    "table for a list": (TOP + "[fin]\nangle = 0.1\n", "3: fin: must be a list of tables, each [[fin]]"),
    "wrong shape": (TOP + "inertia = [1, 2]\n", "3: inertia: has 2 numbers; needs 2 rows of 2 numbers"),
    "ragged": (TOP + "inertia = [[1], [2, 3]]\n", "3: inertia: must be numbers only, in rows of equal length"),
    "NaN in an array": (TOP + "depths = [1, nan]\n", "3: depths: must be finite numbers, not NaN or infinity"),
    "array out of range": (TOP + "depths = [1, 51]\n", "3: depths: [1, 51] is out of range; permitted: 0 to 50 m"),
    "too few": (TOP + "[keel]\nangle = 0\nspan_m = [1]\n", "5: keel.span_m: has 1 number; needs 2 numbers"),
    "rows for a list": (TOP + "depths = [[1, 2], [3, 4]]\n", "3: depths: has 2 rows of 2 numbers; needs a list of numbers"),
    "number for one of several tables": (TOP + "fin = [1]\n", "3: fin[0]: must be a table, [[fin]]"),
    "number for an array": (TOP + "depths = 3\n", "3: depths: has one number alone; needs a list of numbers"),
    "text in an array": (TOP + 'depths = [1, "2"]\n', "3: depths: must be numbers only, in rows of equal length"),
    "truth in an array": (TOP + "inertia = [[1, 0], [true, 1]]\n", "3: inertia: must be numbers only, in rows of equal length"),
    "list without end": (TOP + "depths = [1,\n", "3: not valid TOML: "),
    "text without end": (TOP + 'rig = """a\n', "3: not valid TOML: "),
    "huge number": (NAME + f"length_m = 1{'0' * 400}\n", f"2: length_m: 1{'0' * 56}... is out of range; permitted: 0.1 to 100 m"),
    "huge number in an array": (TOP + f"depths = [1{'0' * 400}]\n", "3: depths: must be finite numbers, not NaN or infinity"),
    "number that no computer can read": (NAME + f"length_m = 1{'0' * 5000}\n", "1: not valid TOML: Exceeds the limit"),
    "brackets without end": (NAME + "length_m = " + "[" * 5000 + "\n", "1: not valid TOML: "),
    "long array out of range": (TOP + f"depths = {[51] * 99}\n", f"3: depths: {str([51] * 99)[:57]}... is out of range"),
    "its own rule at the top": (TOP + 'mate = "Ann"\n', "3: mate must not be the captain"),
    "its own rule": (TOP + "[keel]\nspan_m = [1, 2]\nangle = 0.5\n", "5: keel: angle must not be one half"),
    "its own rule in a row": (TOP + "[[fin]]\nangle = 0\n\n[[fin]]\nangle = 0.5\n", "7: fin[1]: angle must not"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_refused_with_line_and_remedy(tmp_path: Path, case: str) -> None:
    text, words = WRONG[case]
    assert refusal(tmp_path, text).startswith(f"boat.toml:{words}")


def test_number_beyond_every_float_is_refused_where_any_number_is_permitted(tmp_path: Path) -> None:
    assert refusal(tmp_path, TOP + f"heel = -1{'0' * 400}\n").endswith("is out of range; permitted: a value")
    assert refusal(tmp_path, TOP + "heel = inf\n").endswith("inf is out of range; permitted: a value")


def test_line_is_that_of_an_inline_table(tmp_path: Path) -> None:
    assert refusal(tmp_path, TOP + "\n\nkeel = {angle = 7}\n").startswith("boat.toml:5: keel.angle: 7 is out of range")


def test_line_is_that_of_a_dotted_key(tmp_path: Path) -> None:
    assert refusal(tmp_path, TOP + "keel.angle = 7\n").startswith("boat.toml:3: keel.angle: 7 is out of range")


def test_same_key_elsewhere_does_not_mislead_the_line(tmp_path: Path) -> None:
    text = TOP + "[keel]\nangle = 0.1\n[[fin]]\nangle = 0.2\n[[fin]]\nangle = 3\n"
    assert refusal(tmp_path, text).startswith("boat.toml:8: fin[1].angle: 3 is out of range")


@pytest.mark.parametrize("value", [0.1, 100.0, 100])
def test_ends_of_the_range_are_within_it(tmp_path: Path, value: float) -> None:
    boat = load(tmp_path, f'name = "Ann"\nlength_m = {value}\n')
    assert boat.length_m == value
    assert isinstance(boat.length_m, float), "a whole number in the file is a float in the robot"


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"nothing\.toml: cannot be read: No such file"):
        read_toml(tmp_path / "nothing.toml")


def test_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "boat.toml").write_bytes(b"name = \"Ann\"\nrig = \"\xff\xfe\"")
    with pytest.raises(DescriptionError, match=r"boat\.toml:2: cannot be read: byte 0xff is no text in UTF-8; save it as such"):
        read_toml(tmp_path / "boat.toml")


def test_byte_order_mark_of_an_editor_is_no_part_of_the_text(tmp_path: Path) -> None:
    (tmp_path / "boat.toml").write_bytes(b"\xef\xbb\xbfname = 'boat'")
    table, source = read_toml(tmp_path / "boat.toml")
    assert (table, source.text) == ({"name": "boat"}, "name = 'boat'")


def test_arrays_are_read_only_and_in_order(tmp_path: Path) -> None:
    boat = load(tmp_path, TOP + "inertia = [[1, 2], [3, 4]]\n")
    assert boat.inertia.flags.c_contiguous and boat.inertia.dtype == np.float64
    for array in (boat.inertia, boat.depths, boat.keel.span_m):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_frozen_array_is_a_copy() -> None:
    original = np.zeros(3)
    frozen = frozen_array(original)
    original[0] = 1.0
    assert frozen[0] == 0.0


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"low": 0.0, "high": 2.0, "unit": "m"}, "0 to 2 m"),
        ({"low": 0.0, "high": 2.0}, "0 to 2"),
        ({"low": 0.0, "unit": "m"}, "at least 0 m"),
        ({"high": 5.0}, "at most 5"),
        ({"unit": "m"}, "a value in m"),
        ({}, "a value"),
        ({"choices": ("a", "b")}, "one of a, b"),
    ],
)
def test_limits_in_words(limits: dict[str, Any], words: str) -> None:
    field = quantity(**limits)
    assert describe(field.metadata["limits"]) == words


def test_written_description_is_read_back_the_same(tmp_path: Path) -> None:
    written = to_toml(Log())
    assert "size_m = 0.1  # m" in written
    path = tmp_path / "log.toml"
    path.write_text(written)
    table, source = read_toml(path)
    back = build(Log, table, source)
    for field in fields(Log):
        if field.name != "keel":
            np.testing.assert_array_equal(getattr(back, field.name), getattr(Log(), field.name))
    assert back.keel.angle == 0.25


def test_field_without_limits_has_none() -> None:
    @dataclass
    class Bare:
        x: float = 0.0

    assert describe(limits_of(Bare, "x")) == "a value"


def test_error_without_the_key_points_at_the_top() -> None:
    assert str(Source("x.toml", "a = 1\n").error(("b", 2, "c"), "is missing")) == "x.toml:1: b[2].c: is missing"
