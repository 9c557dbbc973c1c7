"""A policy that runs elsewhere: observations go to a policy server, actions come back."""
