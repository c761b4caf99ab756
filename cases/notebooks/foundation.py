# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # One's own energy: a shell on an elastic foundation
#
# A Winkler foundation resists the normal displacement with the energy k/2 w^2 per undeformed area.
# Its stiffness k, in E h/R^2, is an amplitude like the pressure: it can be followed, held, and the
# fold is derived by it.

# %%
from pathlib import Path

import ufl

import magshell_fenicsx as ms


def winkler(r0: ms.kinematics.Jet, u: ms.kinematics.Jet) -> ufl.core.expr.Expr:
    w = -ufl.dot(u.r, ms.kinematics.normal(r0))
    return w**2 / 2


CASES = Path(__file__).parents[1] if "__file__" in globals() else Path("..")
case = ms.Case.load(CASES / "dimple_buckling.yaml")
scene = ms.Scene(case, terms=[ms.OwnTerm("foundation", winkler)])
print(", ".join(scene.problem.included))


# %% [markdown]
# The foundation is there from the start; the pressure grows up to the fold.


# %%
def buckling(stiffness: float) -> list[ms.Record]:
    rest = scene.unloaded()
    on_foundation = rest.with_(rest.u, "foundation", stiffness)
    return list(ms.trace(scene, "pressure", on_foundation, first=0.1))


K, STEP = 0.02, 0.002
records = buckling(K)
fold = records[-1].fold()
slope = ms.gradient(scene, records[-1], of="instability", by="foundation")["foundation"]
print(f"k_d = {fold.value:.9f}, d k_d / d k = {slope:.6f}")

# %% [markdown]
# The same slope from folds at other stiffnesses.

# %%
folds = {
    change: buckling(K + change)[-1].fold().value for change in (-2 * STEP, -STEP, STEP, 2 * STEP)
}
difference = (8 * (folds[STEP] - folds[-STEP]) - (folds[2 * STEP] - folds[-2 * STEP])) / (12 * STEP)
print(f"by finite differences {difference:.6f}")

# %% [markdown] The stiffness itself as the control: the pressure is held below that fold while the
# foundation is taken away, and the shell buckles where too little is left of it.

# %%
P = 0.345
rest = scene.unloaded()
*_, held = ms.trace(scene, "pressure", rest.with_(rest.u, "foundation", K), targets=[P])
softer = list(ms.trace(scene, "foundation", held, first=-K / 10))
critical = softer[-1].fold().value
print(f"at p/p_c = {P} the shell buckles at k = {critical:.9f}")

# %%
curve = ms.curve(scene, softer)
curve  # noqa: B018
