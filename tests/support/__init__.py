"""What several tests share: made-up data, small policies, servers, damage."""
