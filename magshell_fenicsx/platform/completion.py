"""What the shell offers for the next word of a command line."""

from glob import escape, glob


def case_files(incomplete: str) -> list[str]:
    """Case files that begin so, here or one folder deeper; the shell offers its own files where there are none."""
    begin = escape(incomplete)
    found = glob(f"{begin}*.yaml") + glob(f"{begin}*/*.yaml")  # noqa: PTH207 - a Path would lose the ./ that was typed
    return sorted(found)


def left_to_the_shell() -> list[str]:
    """Of any file or folder. Without it the only offer is the word as it stands, to which the shell adds a blank."""
    return []
