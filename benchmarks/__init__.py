"""One script per question, with peers side by side; dated results in `benchmarks/results/`."""
