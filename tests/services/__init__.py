"""The services of a bench session, told as stories."""
