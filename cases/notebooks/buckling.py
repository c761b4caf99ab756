# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # A dimpled hemisphere buckles under pressure, in a field
#
# The field along the axis comes first, then the pressure, up to the fold. From the fold's null
# vector follows how the knockdown factor depends on the field, on the depth of the dimple and on
# the remanence of each part.

# %%
from pathlib import Path

import magshell_fenicsx as ms

CASES = Path(__file__).parents[1] if "__file__" in globals() else Path("..")
case = ms.Case.load(CASES / "dimple_buckling.yaml", ["magnetic.lambda_m=0.00184"])
scene = ms.Scene(case)
print(", ".join(scene.problem.included))

# %% [markdown] Records come one by one; each holds the displacement and the amplitudes
# (`record.point.state.u`, `.mu`).

# %%
records = []
for record in ms.follow(scene):
    records.append(record)
    print(f"{record.label:6} p/p_c = {record.point.state.mu['pressure']:.6f}")

# %% [markdown]
# The columns of path.csv as a frame of pandas; `ms.columns` itself is a mapping of NumPy arrays.

# %%
table = ms.columns(scene, records).to_pandas()
table[["label", "lambda_m", "p_over_pc", "w_pole_over_h", "volume_change"]]

# %%
ms.curve(scene, records)

# %% [markdown]
# The fold to 1e-9 h, and what the knockdown factor depends on.

# %%
fold = records[-1].fold()
knockdown = fold.value
sensitivities = ms.gradient(scene, records[-1], of="instability")
print(f"k_d = {knockdown:.9f}")
for name, value in sensitivities.items():
    print(f"d k_d / d {name} = {value:.6g}")
