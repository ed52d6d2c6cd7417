"""What tests make: tiny clips with their fit, plan and avatar, each built in one place and shared by all."""
