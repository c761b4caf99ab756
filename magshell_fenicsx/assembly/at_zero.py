"""Forms at v = 0 of some coefficient v, found again without their algebra.

The algebra, done once, takes longer than a small run. A file beside the kernels keeps what is left of it.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any

import ufl
from dolfinx import fem

from magshell_fenicsx.platform.kept import keep, recall


class _Found(ufl.Form):  # type: ignore[misc]
    """A form with the signature of another and, of its own coefficients and constants, those that are left there."""

    def __init__(self, form: ufl.Form, signature: str, coefficients: Sequence[int], constants: Sequence[int]) -> None:
        super().__init__(form.integrals())
        left = [form.coefficients()[i] for i in coefficients], [form.constants()[i] for i in constants]
        self._found = signature, *left

    def signature(self) -> str:
        return self._found[0]

    def coefficients(self) -> list[Any]:
        return self._found[1]

    def constants(self) -> list[Any]:
        return self._found[2]


def at_zero(form: ufl.Form, v: fem.Function, compiled: Callable[[ufl.Form], fem.Form]) -> fem.Form:
    """The form at v = 0, compiled; derivatives by v are taken before.

    What is left is kept once its kernel is there: a kernel of the whole form under its signature would be another's.
    """
    number = form.coefficients().index(v)
    key = hashlib.sha256(f"{ufl.__version__} {form.signature()} {number}".encode()).hexdigest()[:40]
    name = f"at_zero_{key}.json"
    if known := recall(name):
        return compiled(_Found(form, **json.loads(known)))
    rest = ufl.replace(form, {v: ufl.zero(v.ufl_shape)})
    kernel = compiled(rest)
    if not rest.empty():
        left = {
            "signature": rest.signature(),
            "coefficients": _numbers(form.coefficients(), rest.coefficients()),
            "constants": _numbers(form.constants(), rest.constants()),
        }
        keep(name, json.dumps(left).encode())
    return kernel


def _numbers(all_: Sequence[Any], some: Sequence[Any]) -> list[int]:
    return [next(i for i, each in enumerate(all_) if each is one) for one in some]
