"""The `tenuto` command: starts, supervises, inspects and stops the processes of a run."""
