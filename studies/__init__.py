"""What is measured with the parts: execution times and latencies."""
