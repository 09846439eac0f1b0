"""The search for effects: linear fits of candidates, exact fits of sets of effects."""
