"""The operator's screen: attaches to a running protocol, shows it, and can stop it.

Glossary: a *bucket* is the smallest and largest sample of a channel over a short stretch of device
time; a *frame* is the immutable state that the link's thread passes to the screen.
"""
