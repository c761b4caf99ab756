"""A design: an optimiser of SciPy over the cases of its variables; every evaluation is kept, the best is verified.

Evaluations are known by their variables: a design that is started again takes those in its folder, walks the same way,
and goes on where it was interrupted.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.opened import read_together, with_same_files
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first, given_folder, held_folder, refuse_others
from magshell_fenicsx.platform import sources
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.simulate.standing import Standing
from magshell_fenicsx.studies.design.evaluate import Evaluation, evaluate
from magshell_fenicsx.studies.design.picture import draw_design
from magshell_fenicsx.studies.design.problem import Problem, problem_of
from magshell_fenicsx.studies.design.search import searched
from magshell_fenicsx.studies.design.variables import Variables, variables
from magshell_fenicsx.studies.design.verify import verified
from magshell_fenicsx.studies.sweep.points import identity
from magshell_fenicsx.studies.sweep.table import write_csv

Array = NDArray[np.float64]
WAY = 4  # stages before the last have this part of the iterations
NOTHING = 1e-10  # change of a result, relative, over the whole range of a variable


class Missed(RuntimeError):
    """The design is not what was asked for; the message says by how much."""


@dataclass
class Design:
    """A design in its folder.

    Attributes
    ----------
    rows
        Of design.csv: one per evaluation.
    tried
        The variables and the evaluations, in the same order; those of the present stage.
    stage
        Number of the wanted shape; 0 of the last.
    """

    variables: Variables
    problem: Problem
    folder: Path
    comm: MPI.Comm
    say: Callable[[str], None]
    rows: list[dict[str, Any]] = field(default_factory=list)
    tried: list[tuple[Array, Evaluation]] = field(default_factory=list)
    stage: int = 0
    _here: str = ""
    _scene: Standing = field(default_factory=Standing)

    def __call__(self, x: Array) -> Evaluation:
        """The evaluation of a vector, known or new; collective."""
        x = np.array(self.comm.bcast(x))
        for known, found in reversed(self.tried):
            if np.array_equal(known, x):
                return found
        stage = f"{self.stage}".encode() if self.stage else b""
        name = hashlib.sha256(x.tobytes() + stage).hexdigest()[:16]
        file, vectors = (self.folder / "points" / f"{name}.{ending}" for ending in ("json", "csv"))
        kept = by_first(self.comm, lambda: self._known(file), "cannot be read")
        found = kept or self._new(x, file, vectors)
        self._add(x, found, name)
        return found

    def begin(self, stage: int, targets: Sequence[Mapping[str, Target]]) -> None:
        """Want the next of several shapes."""
        self.stage = (stage + 1) % len(targets)
        self.problem.targets = targets[stage]
        self.tried.clear()

    def _new(self, x: Array, file: Path, vectors: Path) -> Evaluation:
        by_first(self.comm, lambda: self.variables.write(x, vectors))
        case, problem = self.variables.case_of(x, vectors), self.problem
        found = evaluate(case, x, self.variables, problem.results, problem.targets, self.comm, self._scene)
        found = Evaluation(**self.comm.bcast(asdict(found)))
        content = {"design": self._mine, "sources": sources.ours(), "evaluation": asdict(found)}
        by_first(self.comm, lambda: write_whole(file, (json.dumps(content) + "\n").encode()))
        return found

    @property
    def _mine(self) -> str:
        """Hash of what is designed."""
        if not self._here:
            section = self.variables.case.design
            assert section
            asked = section.model_dump_json(exclude={"iterations", "verify"})
            self._here = hashlib.sha256((identity(self.variables.case) + asked).encode()).hexdigest()[:16]
        return self._here

    def _known(self, file: Path) -> Evaluation | None:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            mine = content["design"] == self._mine and content["sources"] == sources.ours()
            found = Evaluation(**content["evaluation"]) if mine else None
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None
        parts = (found.values, found.gradients, found.beside, found.seen) if found else ()
        return found if all(isinstance(part, dict) for part in parts) else None

    def _add(self, x: Array, found: Evaluation, name: str) -> None:
        self.tried.append((x, found))
        best = self.best
        row = {
            "evaluation": len(self.rows) + 1,
            **{result: found.values.get(result) for result in self.problem.results},
            **found.seen,
            "objective": self.problem.objective(found) if found.values else None,
            "violation": self.problem.violation(found) if found.values else None,
            "best": bool(best and best[0] is x),
            **self.variables.numbers(x),
            **({"stage": self.stage or "last"} if self.problem.stages else {}),
            "note": found.note,
            "point": name,
        }
        self.rows.append(row)
        by_first(self.comm, self._write)
        values = ", ".join(f"{key} = {value:.9g}" for key, value in (found.values | found.seen).items())
        note = f" ({found.note})" if values and found.note else found.note
        self.say(f"{row['evaluation']:5d}  {values}{note}{'  best' if row['best'] else ''}")

    def _write(self) -> None:
        if not any(found.values for _, found in self.tried) and (self.folder / "design.csv").exists():
            return  # one that cannot start replaces nothing
        columns = list(dict.fromkeys(key for row in self.rows for key in row))
        write_csv(self.rows, columns, self.folder / "design.csv")

    @property
    def best(self) -> tuple[Array, Evaluation] | None:
        """The evaluation with the least objective of those that keep the constraints best."""
        there = [each for each in self.tried if each[1].values]
        return min(there, key=lambda each: self.problem.merit(each[1])) if there else None


def design(
    file: Path | str,
    settings: Sequence[str] = (),
    out: Path | str = "results/design",
    *,
    resume: bool = False,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Callable[[str], None] = print_line,
) -> dict[str, Any]:
    """Vary a case for a result; collective. Returns the content of summary.json.

    Parameters
    ----------
    out
        Folder of design.csv (all evaluations), best.yaml with best.csv (the best case and its remanence), design.png,
        summary.json, verified/ (the run of the best case on a finer mesh) and points/.
    resume
        See that the folder has evaluations of this design.

    Raises
    ------
    CaseError
        If the case has no design, or a variable or a result is none.
    Missed
        After everything is written: if a target is not reached, a constraint not kept, or no optimum found.
    """
    source = read_together(file, comm, settings)
    case, folder = with_same_files(Case.from_source(source), comm), given_folder(out)
    if case.design is None:
        raise CaseError(f"{file}: design: is missing: it says what varies and what is wanted")
    try:
        vary, problem = variables(source, case, case.design), problem_of(case, case.design)
    except CaseError as e:
        raise CaseError(case.placed(str(e))) from None
    with held_folder(folder, comm, make=True):
        tables = ("summary.json", "design.csv", "best.yaml", "best.csv", "design.png")
        by_first(comm, lambda: refuse_others(folder, tables, ("objective", "best"), "a design", Path(file).name))
        by_first(comm, lambda: (folder / "points").mkdir(exist_ok=True))
        if resume and not by_first(comm, lambda: any((folder / "points").glob("*.json"))):
            raise CaseError(f"{folder}: has no evaluation to resume")
        made = Design(vary, problem, folder, comm, say)
        try:
            return _designed(made, case, Path(file), comm)
        except CaseError as e:
            raise CaseError(case.placed(str(e))) from None


def _designed(made: Design, case: Case, file: Path, comm: MPI.Intracomm) -> dict[str, Any]:
    vary, problem, section, folder = made.variables, made.problem, case.design, made.folder
    assert section
    targets = [*problem.stages, problem.targets]
    made.begin(0, targets)
    first = made(vary.first)
    if not first.values:
        raise Missed(f"the case itself has no result to start from: {first.note}")
    problem.begin(first)
    idle = _without_influence(vary, first)
    for name in idle:
        made.say(f"warning: {name} has no influence on {', '.join(problem.results)} where the design starts")
    if len(idle) == len(vary.blocks):
        raise Missed(f"no variable has an influence on {', '.join(problem.results)} where the design starts")
    x = vary.first
    for stage in range(len(targets)):
        if stage:
            made.begin(stage, targets)
            problem.begin(made(x))
        last = stage == len(targets) - 1
        ended = searched(made, problem, vary, x, section.iterations if last else -(-section.iterations // WAY))
        found = made.best
        assert found
        x, best = found
    steps = section.remanence.steps if section.remanence else None
    if steps:
        x = vary.rounded(x, steps)
        before, best = best, made(x)
        if not best.values:
            raise Missed(f"with angles in {steps} steps of a turn there is no result: {best.note}")
        made.say(f"angles rounded to {steps} steps of a turn: {problem.words(before)} -> {problem.words(best)}")
    by_first(comm, partial(_write_best, made, x, file))
    content: dict[str, Any] = {
        "case": file.name,
        "objective": section.objective.model_dump(exclude_none=True),
        "start": first.values | first.seen,
        "best": best.values | best.seen,
        "numbers": vary.numbers(x),
        "ended": ended,
        "without_influence": idle,
        "evaluations": len(made.rows),
        "note": best.note,
        "violation": problem.violation(best),
        "sources": sources.ours(),
    }
    by_first(comm, lambda: draw_design(made.rows, problem.results, vary, x, folder / "design.png"))
    by_first(comm, lambda: write_whole(folder / "summary.json", (json.dumps(content, indent=1) + "\n").encode()))
    content["verified"] = verified(folder, section, problem, best, comm, made.say)
    by_first(comm, lambda: write_whole(folder / "summary.json", (json.dumps(content, indent=1) + "\n").encode()))
    if said := problem.missed(best):
        raise Missed(f"{said}; the best case is {folder / 'best.yaml'}")
    return content


def _without_influence(vary: Variables, first: Evaluation) -> list[str]:
    """The variables that change no result."""
    slopes = np.array([first.gradients[result] for result in first.values])
    size = np.array([abs(value) or 1.0 for value in first.values.values()])
    strongest = (np.abs(slopes) / size[:, None]).max(axis=0)
    return [name for name, part in vary.blocks.items() if strongest[part].max() < NOTHING]


def _write_best(made: Design, x: Array, file: Path) -> None:
    """The best case as a file that `magshell run` takes, and its remanence beside it."""
    folder, data = made.folder, made.variables.data(x, "best.csv")
    made.variables.write(x, folder / "best.csv")
    _from_here(data, file.parent.absolute(), folder.absolute())
    text = f"# The best case of a design: {file.name}\n" + yaml.safe_dump(data, sort_keys=False)
    write_whole(folder / "best.yaml", text.encode())


def _from_here(part: Any, old: Path, new: Path) -> None:
    """Let the files that a case names be found from another folder."""
    for key, value in part.items() if isinstance(part, dict) else enumerate(part if isinstance(part, list) else []):
        if key == "file" and isinstance(value, str) and value != "best.csv":
            part[key] = os.path.relpath(old / value, new)
        _from_here(value, old, new)
