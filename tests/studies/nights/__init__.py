"""Evidence that a night loses nothing: kills, damaged journals, faulty queues, hours unattended."""
