"""A process that keeps a CPU busy and does nothing else."""

import argparse

from bayesrace.clock import die_with_parent

__all__: list[str] = []


def main() -> None:
    """Until it is ended, or its parent is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parent-pid", type=int, default=None, help="end with this parent")
    die_with_parent(parser.parse_args().parent_pid)
    while True:
        pass


if __name__ == "__main__":
    main()
