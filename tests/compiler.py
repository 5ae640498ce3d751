"""How XLA compiles in tests: nearly all of a test's time is compilation, which optimizing would only prolong."""

QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
