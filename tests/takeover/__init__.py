"""New weights for a running controller: checks, adoption, watch, store; see ``rig.py``."""
