"""What a bench session is made of: rigs, safety, recorder, run store, attach; no protocols."""
