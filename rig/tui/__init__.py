"""The operator's screen: attaches to a running protocol, shows it, and can stop it.

Glossary: a *bucket* is the smallest and largest sample of a channel over a short stretch of device
time; a *frame* is the immutable picture the link's thread hands to the screen.
"""
