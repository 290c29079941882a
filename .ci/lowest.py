"""Print the oldest versions that pyproject.toml allows, as pins for pip."""

import tomllib
from pathlib import Path

project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
needs = project["dependencies"] + project["optional-dependencies"]["test"]
print(" ".join(need.split(";")[0].replace(">=", "==") for need in needs))
