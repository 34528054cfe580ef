// Reads an Xsens MTi by the maker's own library, as Debian's MRPT has it built in (CIMUXSens_MT4).
// Usage: mti_reader PORT BAUD RATE_HZ SECONDS; prints a line a sample: "sample" and its rate of turn about x, y, z in rad/s.
#include <mrpt/config/CConfigFileMemory.h>
#include <mrpt/hwdrivers/CIMUXSens_MT4.h>
#include <mrpt/obs/CObservationIMU.h>

#include <chrono>
#include <cstdio>
#include <memory>
#include <string>
#include <thread>

// Left by _Exit: the library's destructor waits for a device that may be gone.
int main(int, char **argv)
{
    mrpt::config::CConfigFileMemory said;
    const char *keys[] = {"portname_LIN", "baudRate", "sampleFreq"};
    for (int i = 0; i < 3; i++)
        said.write("imu", keys[i], std::string(argv[1 + i]));
    said.write("imu", "process_rate", std::string("100"));
    said.write("imu", "max_queue_len", std::string("100000"));
    mrpt::hwdrivers::CIMUXSens_MT4 imu;
    imu.loadConfig(said, "imu");
    try {
        imu.initialize();
    } catch (const std::exception &error) {
        fprintf(stderr, "%s\n", error.what());
        fflush(stderr);
        _Exit(1);
    }
    const auto until = std::chrono::steady_clock::now() + std::chrono::milliseconds(int(1000 * atof(argv[4])));
    while (std::chrono::steady_clock::now() < until) {
        imu.doProcess();
        std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    mrpt::hwdrivers::CGenericSensor::TListObservations seen;
    imu.getObservations(seen);
    for (auto &one : seen)
        if (auto sample = std::dynamic_pointer_cast<mrpt::obs::CObservationIMU>(one.second))
            printf("sample %.9g %.9g %.9g\n", sample->get(mrpt::obs::IMU_WX), sample->get(mrpt::obs::IMU_WY),
                   sample->get(mrpt::obs::IMU_WZ));
    fflush(stdout);
    _Exit(0);
}
