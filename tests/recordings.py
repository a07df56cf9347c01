#!/usr/bin/env python3
"""Compares two recordings of one evaluation, value by value: recordings.py FILE.npz FILE.mcap.

Needs: pip install mcap mcap-protobuf-support numpy
"""

import sys

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def messages(path):
    """Returns the decoded messages by topic, and the metadata by name."""
    by_topic = {}
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            by_topic.setdefault(channel.topic, []).append(message)
        names = {found.name: found.metadata for found in reader.iter_metadata()}
    return by_topic, names


def values(by_topic, name, kind):
    """Returns the values of an array as the MCAP file has them."""
    if name == "depth":
        images = by_topic["/camera/image"]
        return np.stack([np.frombuffer(image.data, np.uint8).reshape(image.height, image.width) for image in images])
    fields = [getattr(step, name) for step in by_topic["/drone/step"]]
    return np.array([list(field) if hasattr(field, "__len__") else field for field in fields]).astype(kind)


def main():
    arrays = np.load(sys.argv[1])
    by_topic, names = messages(sys.argv[2])
    for name in arrays.files:
        expected = arrays[name]
        if name in names:
            found = np.array([names[name][str(number)] for number in range(len(expected))])
        else:
            found = values(by_topic, name, expected.dtype)
        if found.shape != expected.shape or not (found == expected).all():
            sys.exit(f"{name} differs between {sys.argv[1]} and {sys.argv[2]}")
    terms = [getattr(reward, name) for name in arrays["reward_term_names"] for reward in by_topic["/drone/reward"]]
    if not (np.array(terms, np.float32).reshape(-1, len(arrays["step"])).T == arrays["reward_terms"]).all():
        sys.exit("the reward's terms differ")
    print(f"{len(arrays['step'])} observations, {len(arrays.files)} arrays: all values are equal")


if __name__ == "__main__":
    main()
