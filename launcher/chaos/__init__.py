"""`tenuto chaos`: faults on purpose, and whether the run kept its promises."""
