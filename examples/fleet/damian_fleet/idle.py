"""Steps in which nothing is reported and nobody chooses, which a service that runs for days need not take."""

from damian.envs.nodes import Belief
from damian.field.node import Memories, Node
from damian.transforms.hold import SampleAndHold


def settles(node: Node) -> int:
    """Steps after which all that has arrived is known to all, if nothing else arrives."""
    return 2 + sum(_periods(node))


def held_back(node: Node) -> int:
    """Steps for which an observation may be held, which must be taken even if nothing arrives."""
    return 0 if _periods(node) == [1, 1] else settles(node)


def diffuses(node: Node) -> bool:
    """Whether something changes in every step, even if nothing arrives."""
    return any(isinstance(each, Belief) for each in node.transforms)


def skip(node: Node, memories: Memories, n_steps: int) -> Memories:
    """The memories after steps in which nothing was reported and nobody chose; beliefs stay the same."""
    found = []
    for transform, memory in zip(node.transforms, memories, strict=True):
        counted = {name: memory[name] + n_steps for name in ("elapsed", "since", "age") if name in memory}
        if isinstance(transform, SampleAndHold):
            counted["elapsed"] = counted["elapsed"] % transform.period
        found.append(memory | counted)
    return found


def _periods(node: Node) -> list[int]:
    return [node.scenario.clock.steps(name) for name in ("agents", "server")]
