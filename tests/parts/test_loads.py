"""The sum of what parts contribute to the loads of a model."""

from magshell_fenicsx.models.shell.parameters import Force
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.interaction import Interaction


def test_contributions_add_up_in_their_order() -> None:
    """Mappings are joined, of other values the first one that is set counts."""
    first = Loads(forces={"force": Force("pole", 0.0)}, interaction=Interaction(2.0))
    second = Loads(
        forces={"force_2": Force("tip", 0.1)}, interaction=Interaction(3.0), pressure=True
    )
    both = first + second
    assert [*both.forces] == ["force", "force_2"]
    assert [*(second + first).forces] == ["force_2", "force"]
    assert both.interaction == Interaction(2.0)
    assert both.pressure
    assert both.displaced == "force"
    assert Loads() + both == both + Loads() == both
