"""Secured links: certificates, access control, and what is said where there is no link."""
