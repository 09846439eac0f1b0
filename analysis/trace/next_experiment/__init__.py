"""The next experiment that answers an open question, and detection limits of effects."""
