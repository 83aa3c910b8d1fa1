"""Delays of messages: delay laws, samplers that draw from them, and a delay line of messages in
transit."""
