"""``python -m operation.cli``, which is how the race starts its processes."""

from operation.cli.app import main

main()
