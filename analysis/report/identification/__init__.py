"""The report of an identification: its page, tables and figures."""
