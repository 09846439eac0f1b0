"""The trace on benches with hidden effects: right names, wrong names, abstentions."""
