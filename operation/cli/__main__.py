"""``python -m bayesrace.operation.cli``, which is how the race starts its processes."""

from bayesrace.operation.cli.app import main

main()
