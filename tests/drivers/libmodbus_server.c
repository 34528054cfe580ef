/* A drive that is not ours: libmodbus serves Kinco registers from memory, statusword and rate follow what is written.
 * Usage: libmodbus_server tcp | libmodbus_server rtu PORT. Prints the TCP port, or 0, when it listens. */
#include <arpa/inet.h>
#include <modbus.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { FIRST = 0x1F00, LAST = 0x6F01, CONTROL = 0x3100, STATUS = 0x3200, RATE = 0x3B00, TARGET = 0x6F00 };

static uint16_t *at(modbus_mapping_t *map, int address) { return map->tab_registers + (address - FIRST); }

static void follow(modbus_mapping_t *map)
{
    uint16_t control = *at(map, CONTROL), *status = at(map, STATUS);
    int enabled = 0;
    if (!(control & 0x02))
        *status = 0x0040; /* switch on disabled */
    else if (!(control & 0x04))
        *status = (*status & 0x6F) == 0x27 ? 0x0007 : *status; /* quick stop active */
    else if ((control & 0x0F) == 0x0F && ((*status & 0x6F) == 0x23 || (*status & 0x6F) == 0x27))
        *status = 0x0027; /* operation enabled */
    else if ((control & 0x0F) == 0x07 && (*status & 0x6F) == 0x21)
        *status = 0x0023; /* switched on */
    else if ((control & 0x0F) == 0x06)
        *status = 0x0021; /* ready to switch on */
    enabled = *status == 0x0027;
    *status |= 0x0410; /* voltage enabled, target reached */
    memset(at(map, RATE), 0, 4);
    if (enabled)
        memcpy(at(map, RATE), at(map, TARGET), 4);
}

int main(int argc, char **argv)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int over_tcp = argc == 2, size, listener = -1;
    struct sockaddr_in bound;
    socklen_t length = sizeof bound;
    modbus_t *bus = over_tcp ? modbus_new_tcp("127.0.0.1", 0) : modbus_new_rtu(argv[2], 115200, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new_start_address(0, 0, 0, 0, FIRST, LAST - FIRST + 1, 0, 0);
    *at(map, STATUS) = 0x0450;
    modbus_set_slave(bus, 1);
    if (over_tcp) {
        listener = modbus_tcp_listen(bus, 1);
        getsockname(listener, (struct sockaddr *)&bound, &length);
    } else if (modbus_connect(bus) != 0) {
        return 1;
    }
    printf("%d\n", over_tcp ? ntohs(bound.sin_port) : 0);
    fflush(stdout);
    if (over_tcp)
        modbus_tcp_accept(bus, &listener);
    while ((size = modbus_receive(bus, query)) >= 0 || !over_tcp)
        if (size > 0 && modbus_reply(bus, query, size, map) > 0)
            follow(map);
    return 0;
}
