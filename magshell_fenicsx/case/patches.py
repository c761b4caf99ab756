"""Keys with values by patch: the names that a shell has."""

from collections.abc import Collection, Iterable

from magshell_fenicsx.shape.sections import MeshSurface, Surface
from magshell_fenicsx.shape.shell import ShellSection

REMANENCE = "magnetic.remanent.patches"


def refuse_strange(key: str, patches: Iterable[str], shell: ShellSection | Surface, dimples: Collection[str]) -> None:
    """See that a shell has the patches of a key; a mesh file knows its own later.

    Parameters
    ----------
    dimples
        Names of the patches within the rims of the shell's dimples.

    Raises
    ------
    ValueError
        If it has not, or the remanence of the rest is missing.
    """
    if isinstance(shell, MeshSurface):
        return
    if not dimples and ("dimple" in patches or not isinstance(shell, ShellSection)):
        raise ValueError(f"{key}: the shell has no dimple: patches are those within dimples, or of a mesh file")
    known = [*(dimples or ["dimple"]), "rest"]
    if unknown := set(patches) - set(known):
        raise ValueError(f"{key}: {min(unknown)}: a {shell.geometry} has only {', '.join(known[:-1])} and rest")
    if key == REMANENCE and "rest" not in patches:
        raise ValueError("magnetic.remanent: patches needs the patch rest")
