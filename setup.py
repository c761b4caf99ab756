"""What pyproject.toml cannot say: the example cases stand beside the package and are installed
inside it.
"""

from setuptools import find_packages, setup

# examples/ is no folder of the repository: magshell_fenicsx/case/examples.py finds the cases in
# both places
EXAMPLES = {f"magshell_fenicsx.examples.{folder}": folder for folder in ("cases", "meshes")}

setup(packages=[*find_packages(include=["magshell_fenicsx*"]), *EXAMPLES], package_dir=EXAMPLES)
