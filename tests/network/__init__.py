"""Two hosts and a bad link between them, on one machine: see ``hosts.py``."""
