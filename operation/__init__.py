"""How the parts run together: preparation, races, drives, learning, reports, command line."""
