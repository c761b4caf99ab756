"""Completions that the shell offers for a command line."""

from glob import escape, glob


def case_files(incomplete: str) -> list[str]:
    """Case files with this beginning, here or one folder deeper; without any, the shell offers its own files."""
    begin = escape(incomplete)
    found = glob(f"{begin}*.yaml") + glob(f"{begin}*/*.yaml")  # noqa: PTH207 - a Path would lose the ./ that was typed
    return sorted(found)


def left_to_the_shell() -> list[str]:
    """No completions of ours, so that the shell completes files; by default it would only add a blank."""
    return []
