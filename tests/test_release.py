"""What a release consists of: one version everywhere, and packages that hold what they need."""

import re
import tomllib
from pathlib import Path

import fractaljax as fj

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
RECIPE = (ROOT / "conda" / "recipe.yaml").read_text()
CONDA_NAMES = {"matplotlib": "matplotlib-base"}  # without the window toolkits


def listed(section: str) -> set[str]:
    """The items under a key of the recipe, without blanks."""
    (items,) = re.findall(rf"^ *{section}:\n((?: +- .*\n)+)", RECIPE, re.M)
    return {item.replace(" ", "") for item in re.findall(r"- (.*)", items)}


def test_recipe_asks_for_what_pyproject_asks_for_in_one_version():
    project, found = PROJECT["project"], {"python>=${{python_min}}"}
    for need in project["dependencies"]:
        name, bound = need.split(">=")
        found.add(f"{CONDA_NAMES.get(name, name)}>={bound}")
    assert listed("run") == found
    built = {"python${{python_min}}.*", "pip", *PROJECT["build-system"]["requires"]}
    assert listed("host") == built
    (least,) = re.findall(r'python_min: "(.*)"', RECIPE)
    assert project["requires-python"] == f">={least}"
    (command,) = project["scripts"].items()
    for said in (" = ".join(command), project["description"], f"license: {project['license']}"):
        assert said in RECIPE
    assert re.findall(r'  version: "(.*)"', RECIPE) == [fj.__version__]
    assert f"version: {fj.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    first = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[0]
    assert first.rstrip(",") == fj.__version__
