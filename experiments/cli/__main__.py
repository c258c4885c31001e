"""``python -m experiments.cli``, which is how the race starts its processes."""

from experiments.cli.app import main

main()
