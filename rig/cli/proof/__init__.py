"""Plans proved on the twin, and the errors predicted for them."""
