"""The process that plays the car: what it does when driven, and what it lets itself be told."""
