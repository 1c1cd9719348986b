"""Collectors: where the policy runs in the environments, in this process or in workers."""
