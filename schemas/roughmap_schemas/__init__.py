"""The contract: messages, key expressions, codecs and configuration that the service and its clients share."""
