"""Operations on scalars as a function in C, for many points in one call and four points at once."""

import ctypes
from collections.abc import Callable, Sequence
from typing import TypeAlias

from magshell_fenicsx.assembly.scalars import Scalars

COMPILED: TypeAlias = Callable[[int, int, int, int, int], None]  # addresses but for the fourth: number of points
NAME = "evaluate_many"
OPTIONS = ("-std=gnu17", "-O1", "-g0", "-ffast-math")  # -O2 compiles five times slower, for 15 % of the run time
INFIX = {"+", "*", "/", "<", ">", "<=", ">=", "==", "!=", "&", "|"}
MASKS = INFIX - {"+", "*", "/"} | {"!"}
PREAMBLE = """#include <math.h>
#include <stdint.h>

typedef double four __attribute__((vector_size(32), aligned(8)));
typedef int64_t mask __attribute__((vector_size(32), aligned(8)));

static inline four pick(mask m, four a, four b) { return (four)((m & (mask)a) | (~m & (mask)b)); }
"""
OF_ONE = "static inline four four_{f}(four x) {{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i]); return x; }}\n"
OF_TWO = """static inline four four_{f}(four x, four y)
{{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i], y[i]); return x; }}
"""
POINTS = """
/* values: of each field (n, size), row by row. constants: of all. out: (n, {count}). */
void {name}(const double* const* values, const int32_t* sizes, const double* constants, int64_t n, double* out)
{{
  const four none = {{0}};
  for (int64_t p = 0; p < n; p += 4) {{
    int64_t at[4];
    for (int i = 0; i < 4; ++i) at[i] = p + i < n ? p + i : n - 1;
{body}
    for (int i = 0; i < 4 && p + i < n; ++i)
      for (int k = 0; k < {count}; ++k) out[(p + i) * {count} + k] = A[k][i];
  }}
}}
"""


def point_code(scalars: Scalars, outputs: Sequence[int]) -> str:
    """The source of a function that gives some nodes at many points."""
    order, names = scalars.reached(outputs), dict[int, str]()
    lines, functions = [f"four A[{len(outputs)}];"], dict[str, int]()
    wanted = dict[int, list[int]]()
    for k, node in enumerate(outputs):
        wanted.setdefault(node, []).append(k)
    for node in order:
        name, *rest = scalars.operations[node]
        if name == "number":
            names[node] = f"({rest[0]!r})"
        else:
            names[node], kind = f"x{node}", "mask" if name in MASKS else "four"
            lines.append(f"const {kind} x{node} = {_operation(name, rest, names, functions)};")
        lines += [f"A[{k}] = none + {names[node]};" for k in wanted.get(node, ())]
    helpers = "".join((OF_ONE if count == 1 else OF_TWO).format(f=f) for f, count in functions.items())
    body = "\n".join(f"    {line}" for line in lines)
    return PREAMBLE + helpers + POINTS.format(name=NAME, count=len(outputs), body=body)


def function_of(library: ctypes.CDLL) -> COMPILED:
    """The function of a library, with the types of its arguments: fields, sizes, constants, count, out."""
    function, pointer = library[NAME], ctypes.c_void_p
    function.argtypes, function.restype = [pointer, pointer, pointer, ctypes.c_int64, pointer], None
    return function


def _operation(name: str, rest: list[int], names: dict[int, str], functions: dict[str, int]) -> str:
    if name == "field":
        return "{" + ", ".join(f"values[{rest[0]}][at[{i}] * sizes[{rest[0]}] + {rest[1]}]" for i in range(4)) + "}"
    if name == "constant":
        return f"none + constants[{rest[0]}]"
    operands = [names[node] for node in rest]
    if name == "pick":
        return f"pick({operands[0]}, none + {operands[1]}, none + {operands[2]})"
    if name == "!":
        return f"~{operands[0]}"
    if name in INFIX:
        first = f"(none + {operands[0]})" if operands[0][0] == "(" and name in MASKS else operands[0]
        return f"{first} {name} {operands[1]}"
    if name in ("jn", "yn"):  # of an order that is a number
        return "{" + ", ".join(f"{name}((int){operands[0]}, {operands[1]}[{i}])" for i in range(4)) + "}"
    functions[name] = len(operands)
    return f"four_{name}({', '.join(f'none + {operand}' for operand in operands)})"
