"""What runs the parts together: race, benchmark, report, command line."""
