"""How XLA compiles in tests: nearly all of a test's time is compilation, which optimizing would only prolong."""

import shutil
from pathlib import Path

QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
KEPT = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
MOST = 10**9  # bytes


def keep_what_is_compiled() -> None:
    """For the workers beside this one, and for the next time, which takes two thirds as long.

    JAX knows a program by what it consists of, so that changed code is compiled anew. Only pytest's own processes keep something
    here: others are killed by tests, and might leave half of it.
    """
    import jax  # which reads settings that come before it

    if KEPT.is_dir() and sum(path.stat().st_size for path in KEPT.iterdir()) > MOST:
        shutil.rmtree(KEPT, ignore_errors=True)
    jax.config.update("jax_compilation_cache_dir", str(KEPT))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
