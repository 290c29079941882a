import sys, hashlib, time
sys.path.insert(0, "tests")
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from programs import PROGRAMS
import fractaljax; print(fractaljax.__file__, file=sys.stderr)
for name, p in PROGRAMS.items():
    t=time.time()
    text = jax.jit(p.function).lower(jnp.asarray(p.value, float)).as_text()
    print(name, hashlib.sha1(text.encode()).hexdigest(), len(text), flush=True, sep="\t")
