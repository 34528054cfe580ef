"""Checksums and CRCs by their parameters, in the form of the catalogue of parametrised CRC algorithms (G. Cook)."""

from dataclasses import dataclass
from functools import cache, reduce
from operator import xor

_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True, slots=True)
class Check:
    """A checksum of 8 bits or more: ``kind`` is "crc", "sum", "negated sum", "xor" or "fletcher".

    The other fields are for CRCs. A Fletcher checksum is the sum of the bytes, then the sum of all partial sums, each
    in half of the bits.
    """

    kind: str
    bits: int
    polynomial: int = 0
    init: int = 0
    reflected: bool = False
    xorout: int = 0

    def of(self, data: bytes) -> int:
        """Return the checksum of ``data``, as a number of ``bits`` bits: a CRC, xor, Fletcher or the sum of bytes,
        maybe negated.

        Fletcher's has the plain sum in its upper half.
        """
        if self.kind == "crc":
            return self._crc(data)
        if self.kind == "xor":
            return reduce(xor, data, 0)
        if self.kind == "fletcher":
            half = 1 << self.bits // 2
            return sum(data) % half * half + sum((len(data) - i) * byte for i, byte in enumerate(data)) % half
        return (-sum(data) if self.kind == "negated sum" else sum(data)) % (1 << self.bits)

    def _crc(self, data: bytes) -> int:
        table, value = _table(self.bits, self.polynomial), self.init
        for byte in data.translate(_MIRRORED) if self.reflected else data:
            value = (value << 8) % (1 << self.bits) ^ table[value >> self.bits - 8 ^ byte]
        return (int(f"{value:0{self.bits}b}"[::-1], 2) if self.reflected else value) ^ self.xorout


@cache
def _table(bits: int, polynomial: int) -> tuple[int, ...]:
    """Return the 256 entries of a CRC's lookup table, for the byte that is shifted out."""
    values = []
    for byte in range(256):
        value = byte << bits - 8
        for _ in range(8):
            value = value << 1 ^ (polynomial | 1 << bits if value >> bits - 1 else 0)
        values.append(value)
    return tuple(values)
