import pytest

from swarmsim.policies import get, names, register
from swarmsim.policies.registry import _policies


def test_shipped_policies_are_found_by_name():
    assert "parallel_lines" in names("aerial")
    assert "approach_and_orbit" in names("ground")


def test_unknown_names_list_the_known_ones():
    with pytest.raises(KeyError, match="parallel_lines"):
        get("aerial", "spiral")
    with pytest.raises(ValueError, match="aerial, ground"):
        register("naval", "x")


def test_a_name_belongs_to_one_function():
    @register("aerial", "mine")
    def mine(task, site):
        return task

    try:
        assert get("aerial", "mine") is mine
        with pytest.raises(ValueError, match="already"):
            register("aerial", "mine")(lambda task, site: site)
    finally:
        del _policies["aerial"]["mine"]
