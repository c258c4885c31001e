"""What is measured with the parts: execution times, latencies, laps by the thousand."""
