"""Every permitted set of parameters survives being written and read back; every other value is refused."""

from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.description.parameters import Parameters, load_parameters, registry
from firmware_py.description.schema import DescriptionError
from firmware_py.description.toml_text import to_toml

always = settings(derandomize=True, deadline=None, database=None, max_examples=60)
REGISTRY = dict(registry())
NUMBERS = sorted(name for name, limits in REGISTRY.items() if not limits.choices)


def permitted(name: str) -> st.SearchStrategy[float | str]:
    limits = REGISTRY[name]
    if limits.choices:
        return st.sampled_from(limits.choices)
    if isinstance(attrgetter(name)(Parameters()), int):
        return st.integers(int(limits.low), int(limits.high))
    return st.floats(limits.low, limits.high)


changes = st.lists(st.sampled_from(sorted(REGISTRY)), unique=True, max_size=8).flatmap(
    lambda names: st.fixed_dictionaries({name: permitted(name) for name in names})
)


@always
@given(changes)
def test_permitted_set_survives_its_file(values: dict[str, float | str]) -> None:
    parameters = Parameters()
    for name, value in values.items():
        parameters = parameters.replace(name, value)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "p.toml"
        path.write_text(to_toml(parameters))
        assert load_parameters(path) == parameters


@always
@given(st.sampled_from(NUMBERS), st.floats(allow_nan=True, allow_infinity=True))
def test_number_is_taken_if_and_only_if_it_is_in_range(name: str, value: float) -> None:
    limits = REGISTRY[name]
    try:
        taken = Parameters().replace(name, value)
    except DescriptionError as refused:
        is_whole = isinstance(attrgetter(name)(Parameters()), int)
        assert not limits.low <= value <= limits.high or (is_whole and not float(value).is_integer())
        assert name in str(refused) and "permitted" in str(refused)
    else:
        assert limits.low <= value <= limits.high
        assert attrgetter(name)(taken) == value
