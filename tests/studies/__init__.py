"""Evidence: studies of the method, the paper's reproduction, measured machines."""
