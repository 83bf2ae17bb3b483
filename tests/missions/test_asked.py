"""Policies of users that fail, or answer what cannot be, are told as wrong input with the file and the line."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import pytest
from jax.tree_util import register_pytree_node_class

from swarmsim.config.errors import InputError
from swarmsim.control.commands import DriveCommand, fly_velocity
from swarmsim.missions.asked import Asked
from swarmsim.vehicles.multirotor import MultirotorParams

HERE = Path(__file__).name
ROVER = SimpleNamespace(params=None)


class Policy:
    """What a user's file holds; ``answer`` is what `act` gives."""

    period_s = 0.5

    def __init__(self, answer):
        self.answer = answer

    def start(self, task, key):
        raise KeyError("boom")

    def act(self, task, memory, view, key):
        return self.answer(memory) if callable(self.answer) else self.answer


def uav():
    params = object.__new__(MultirotorParams)
    object.__setattr__(params, "rotor_spin", jnp.ones(4))
    return SimpleNamespace(params=params)


def test_attributes_are_the_policys_own() -> None:
    asked = Asked("my.py:P", Policy(None))
    assert asked.period_s == 0.5
    assert not hasattr(asked, "plan")
    assert not hasattr(asked, "done")


def test_a_method_that_fails_says_where() -> None:
    with pytest.raises(InputError, match=rf"start\(\) of the policy 'my.py:P' fails: .*{HERE}:\d+: KeyError: 'boom'"):
        Asked("my.py:P", Policy(None)).start(None, None)


def test_a_method_of_other_arguments_is_told_without_a_line_of_ours() -> None:
    with pytest.raises(InputError, match=r"start\(\) of the policy 'my.py:P' fails: TypeError: ") as told:
        Asked("my.py:P", SimpleNamespace(start=lambda only: only)).start(None, None)
    assert "asked.py" not in str(told.value)


def test_what_a_branch_on_a_traced_value_says_is_one_line() -> None:
    import jax

    def act(memory):
        return (memory if memory > 0.0 else -memory), fly_velocity(jnp.zeros(3))

    with pytest.raises(InputError) as told:
        jax.jit(lambda m: Asked("my.py:P", Policy(act)).act(uav(), m, None, None)[0])(jnp.zeros(()))
    (problem,) = told.value.problems
    assert f"{HERE}:" in problem.message
    assert "TracerBoolConversionError" in problem.message
    assert "\n" not in problem.message


@pytest.mark.parametrize(
    ("task", "answer", "fragment"),
    [
        (uav, 3, "must give two values"),
        (uav, lambda m: (jnp.zeros(3), fly_velocity(jnp.zeros(3))), "must give a memory of the shape and type"),
        (uav, lambda m: (jnp.zeros(2, jnp.int32), fly_velocity(jnp.zeros(3))), "must give a memory of the shape"),
        (uav, lambda m: ((m, m), fly_velocity(jnp.zeros(3))), "must give a memory of the shape and type"),
        (uav, lambda m: (m, 3), "gives no command: a multirotor is commanded by one of PositionCommand"),
        (uav, lambda m: (m, fly_velocity(jnp.zeros(2))), "has the shape"),
        (lambda: ROVER, lambda m: (m, fly_velocity(jnp.zeros(3))), "a skid-steer rover is commanded by one of"),
    ],
)
def test_what_act_gives_is_looked_at(task, answer, fragment) -> None:
    with pytest.raises(InputError, match=fragment):
        Asked("my.py:P", Policy(answer)).act(task(), jnp.zeros(2), None, None)


@register_pytree_node_class
class Memory:
    """A user's own, which prints as its address."""

    def __init__(self, place, level):
        self.place, self.level = place, level

    def tree_flatten(self):
        return (self.place, self.level), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls(*leaves)


def test_memories_are_compared_by_what_they_hold_and_not_by_how_they_print() -> None:
    def grown(m):
        return (Memory(m[0].place + 1.0, m[0].level), Memory(m[1].place, m[1].level)), fly_velocity(jnp.zeros(3))

    before = (Memory(jnp.zeros(2), jnp.zeros(())), Memory(jnp.zeros(3), jnp.zeros(())))
    after, _ = Asked("my.py:P", Policy(grown)).act(uav(), before, None, None)
    assert after[0].place.tolist() == [1.0, 1.0]
    wrong = Policy(lambda m: ((m[0], Memory(m[1].place[:2], m[1].level)), fly_velocity(jnp.zeros(3))))
    with pytest.raises(InputError, match="shape and type") as told:
        Asked("my.py:P", wrong).act(uav(), before, None, None)
    assert "float32[2]" in str(told.value)
    assert " at 0x" not in str(told.value)


@pytest.mark.parametrize("given", ["text", {1, 2}, {"a": "text"}, (jnp.zeros(2), print)])
def test_what_is_no_array_is_told(given) -> None:
    policy = SimpleNamespace(
        start=lambda *_: given, task=lambda *_: given, act=lambda *_: (given, fly_velocity(jnp.zeros(3)))
    )
    asked = Asked("my.py:P", policy)
    for name, call in (
        ("start", lambda: asked.start(None, None)),
        ("task", lambda: asked.task(None)),
        ("act", lambda: asked.act(uav(), jnp.zeros(2), None, None)),
    ):
        with pytest.raises(InputError, match=rf"{name}\(\) of the policy 'my.py:P' must give arrays"):
            call()


@pytest.mark.parametrize("given", [None, jnp.zeros(3, bool), 1.0, "yes"])
def test_a_policy_is_done_or_not(given) -> None:
    with pytest.raises(InputError, match=r"done\(\) of the policy 'my.py:P' must give"):
        Asked("my.py:P", SimpleNamespace(done=lambda *_: given)).done(None, None, None)
    for right in (True, jnp.array(False)):
        assert Asked("my.py:P", SimpleNamespace(done=lambda *_, right=right: right)).done(None, None, None) is right


@pytest.mark.parametrize("given", [None, jnp.zeros((3, 3))])
def test_a_planner_gives_paths(given) -> None:
    with pytest.raises(InputError, match="must give the paths of its vehicles"):
        Asked("my.py:P", SimpleNamespace(plan=lambda *_: given)).plan(None, None, None)


def test_a_command_with_a_word_in_it_is_told() -> None:
    command = replace(fly_velocity(jnp.zeros(3)), yaw_rad="north")
    with pytest.raises(InputError, match="gives no command"):
        Asked("my.py:P", Policy((jnp.zeros(2), command))).act(uav(), jnp.zeros(2), None, None)


def test_what_is_right_passes() -> None:
    drive = DriveCommand(speed_m_s=jnp.zeros(()), yaw_rate_rad_s=jnp.zeros(()))
    memory, command = Asked("my.py:P", Policy(lambda m: (m + 1.0, drive))).act(ROVER, jnp.zeros(2), None, None)
    assert command is drive
    assert memory.tolist() == [1.0, 1.0]
