"""New weights for a running controller: gate, gatekeeper, takeover, watch; see ``rig.py``."""
