"""What `import fractaljax` loads, and what an answer does: a user waits for no more."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import fractaljax as fj

HEAVY = ("diffrax", "optimistix", "lineax", "optax", "matplotlib", "scipy", "tqdm", "sympy", "zarr")
ARRAYS = ("jax", "jaxlib", "numpy", "equinox", "jaxtyping")
LOADED = "import sys; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
OWN = "import sys; print(*(name for name in sys.modules if name.startswith('fractaljax.')))"


def printed(code):
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_the_import_loads_nothing_and_knows_its_names():
    """Not even JAX: it comes with the first name that is used."""
    assert not {*HEAVY, *ARRAYS} & printed(f"import fractaljax; {LOADED}")
    assert not {*HEAVY, *ARRAYS} & printed(f"import fractaljax.__main__; {LOADED}")
    with pytest.raises(AttributeError, match=r"^module 'fractaljax' has no attribute 'nonsense'$"):
        fj.nonsense  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_a_growth_rate_loads_what_it_needs():
    """Integrators, optimisers and plotting come with the call that needs them."""
    asked = "import fractaljax as fj; fj.growth_rate(fj.brake_scene())"
    assert not {*HEAVY, "SurfaceTopography"} & printed(f"{asked}; {LOADED}")
    packages = {name.split(".")[1] for name in printed(f"{asked}; {OWN}")}
    assert packages == {
        "_base", "_contact", "_friction", "_mechanism", "_stability", "_surface", "_version"
    }  # fmt: skip


def test_a_growth_rate_with_memory_loads_no_integrator():
    law = "fj.LuGre(0.4, 0.3, 0.1, 1e6, 3.0)"
    asked = f"import fractaljax as fj; fj.growth_rate(fj.brake_scene().replace(friction={law}))"
    assert {*HEAVY} & printed(f"{asked}; {LOADED}") <= {"scipy"}  # for linear algebra


@pytest.mark.parametrize("package", [fj, fj.plot])
def test_names_are_those_of_the_stub(package):
    """Also where a module has the name of a function in it, whichever is imported first."""
    stub = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    names = [name.asname for node in stub.body for name in getattr(node, "names", [])]
    assert set(names) == set(package.__all__) <= set(dir(package)) and len(names) > 30
    for name in names:
        assert getattr(package, name) is not None
    importlib.import_module("fractaljax.plot.cycle")
    assert callable(fj.plot.cycle)
    first = "import fractaljax.plot.cycles, fractaljax; print(callable(fractaljax.plot.cycle))"
    assert printed(first) == {"True"}
