"""The OCP as CasADi expressions, its C, the compiled artefact and its cache."""
