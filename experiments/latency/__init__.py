"""``bayesrace latency``: where a control cycle's time goes, measured from the messages."""
