"""Named run configurations and the experiments that are built on them."""
