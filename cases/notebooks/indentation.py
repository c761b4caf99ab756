# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # Indentation at the pole: the curve, and the shell as arrays and as a picture

# %%
from pathlib import Path

import numpy as np

import magshell_fenicsx as ms

CASES = Path(__file__).parents[1] if "__file__" in globals() else Path("..")
scene = ms.Scene(ms.Case.load(CASES / "pole_indentation.yaml"))
records = list(ms.follow(scene))
table = ms.columns(scene, records)
asked = table["label"] == "target"
force = table["force"][asked]
for w, F in zip(table["w_over_h"][asked], force, strict=True):
    print(f"w/h = {w:.3f}   F R/(2 pi D) = {F:.5f}")

# %%
curve = ms.curve(scene, records)
curve  # noqa: B018

# %% [markdown]
# The deformed mid-surface: `surface` has the nodes as arrays, `polydata` flat triangles for pyvista
# (`polydata(...).plot(scalars="w_over_h")` shows them).

# %%
shell = ms.surface(scene, records[-1])
triangles = ms.polydata(scene, records[-1])
print(f"largest w/h {shell.w.max() / scene.problem.material.h:.3f}, {triangles.n_points} points")
dent = np.linalg.norm(shell.r0[shell.w > scene.problem.material.h] * [1, 1, 0], axis=1).max()
print(f"w > h up to {np.degrees(np.arcsin(dent)):.2f} degrees from the pole")

# %%
picture = ms.picture(scene, records[-1])
picture  # noqa: B018
