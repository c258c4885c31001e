"""Offline learning: datasets from logs, GP training, validation. The only scikit-learn user."""
